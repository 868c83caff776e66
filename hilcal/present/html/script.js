// Draws each chart when it comes near the screen, in the colour scheme of the page, and all charts
// before the page is printed. The page is shown first. Then the text of plotly.js gets a URL, since
// browsers compile a script with a URL in the background, an inline script not.
"use strict";
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const paper = window.matchMedia("print");
const charts = [...document.querySelectorAll(".chart")];
const waiting = new Set(); // charts near the screen that are not drawn yet
let onPaper = false;
const look = () => (dark.matches && !onPaper && !paper.matches ? LOOKS.dark : LOOKS.light);

const afterPicture = (act) => requestAnimationFrame(() => setTimeout(act));

function load() {
  const script = document.createElement("script");
  const text = document.getElementById("plotly").textContent;
  script.src = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  script.onload = next;
  script.onerror = () => { loadNow(); next(); };
  document.head.append(script);
}
function loadNow() {
  if (window.Plotly) return;
  const script = document.createElement("script");
  script.textContent = document.getElementById("plotly").textContent;
  document.head.append(script);
}

function draw(at) {
  if (at.dataset.drawn) return;
  at.dataset.drawn = "1";
  const figure = JSON.parse(at.parentElement.querySelector("script").textContent);
  figure.layout.template = look();
  figure.layout.autosize = true;
  Plotly.newPlot(at, figure.data, figure.layout, CONFIG);
}

function drawAll() {
  loadNow();
  charts.forEach(draw);
}

// One chart per animation frame, first the chart nearest to the middle of the screen.
let drawing = false;
function next() {
  if (drawing || !window.Plotly || !waiting.size) return;
  drawing = true;
  afterPicture(() => {
    const far = (at) => {
      const box = at.getBoundingClientRect();
      return Math.abs(box.top + box.bottom - window.innerHeight);
    };
    const [at] = [...waiting].sort((a, b) => far(a) - far(b));
    waiting.delete(at);
    if (at) draw(at);
    drawing = false;
    next();
  });
}

function dress() {
  for (const at of charts) {
    if (at.dataset.drawn) Plotly.relayout(at, { template: look() });
  }
}

const near = new IntersectionObserver(
  (entries) => {
    for (const e of entries) {
      if (e.isIntersecting) waiting.add(e.target);
      else waiting.delete(e.target);
    }
    next();
  },
  { rootMargin: "400px" },
);
charts.forEach((at) => near.observe(at));
dark.addEventListener("change", dress);
afterPicture(load);

function printing() {
  onPaper = true;
  document.documentElement.classList.add("printing");  // as wide as the paper
  drawAll();
  dress();
  for (const at of charts) Plotly.Plots.resize(at);
}
window.addEventListener("beforeprint", printing);
window.addEventListener("afterprint", () => {
  onPaper = false;
  document.documentElement.classList.remove("printing");
  dress();
  charts.forEach((at) => at.dataset.drawn && Plotly.Plots.resize(at));
});
