// Draws each chart when it comes near the screen, in the colours of the page, and all of them
// before the page is printed.
"use strict";
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const paper = window.matchMedia("print");
const charts = [...document.querySelectorAll(".chart")];
let onPaper = false;
const look = () => (dark.matches && !onPaper && !paper.matches ? LOOKS.dark : LOOKS.light);

function draw(at) {
  if (at.dataset.drawn) return;
  at.dataset.drawn = "1";
  const figure = JSON.parse(at.parentElement.querySelector("script").textContent);
  figure.layout.template = look();
  figure.layout.autosize = true;
  Plotly.newPlot(at, figure.data, figure.layout, CONFIG);
}

function dress() {
  for (const at of charts) {
    if (at.dataset.drawn) Plotly.relayout(at, { template: look() });
  }
}

const near = new IntersectionObserver(
  (entries) => entries.filter((e) => e.isIntersecting).forEach((e) => { near.unobserve(e.target); draw(e.target); }),
  { rootMargin: "400px" },
);
charts.forEach((at) => near.observe(at));
dark.addEventListener("change", dress);

const folded = [...document.querySelectorAll("details")];
let wereOpen = [];
function printing() {
  onPaper = true;
  wereOpen = folded.map((d) => d.open);
  folded.forEach((d) => { d.open = true; });
  document.documentElement.classList.add("printing");  // as wide as the paper
  charts.forEach(draw);
  dress();
  for (const at of charts) Plotly.Plots.resize(at);
}
window.addEventListener("beforeprint", printing);
window.addEventListener("afterprint", () => {
  onPaper = false;
  folded.forEach((d, k) => { d.open = wereOpen[k]; });
  document.documentElement.classList.remove("printing");
  dress();
  charts.forEach((at) => at.dataset.drawn && Plotly.Plots.resize(at));
});
