/* Keeps the answer to a click at its place on the screen while the page is redrawn. */
(() => {
  let place = null, want = null, last = null, moved = 0;
  for (const kind of ["wheel", "touchmove", "keydown", "pointerdown"])
    addEventListener(kind, () => { moved = performance.now(); }, true);
  addEventListener("click", (e) => {
    const card = e.target.closest("button") && e.target.closest(".part");
    const answer = card && card.querySelector(".answer");
    if (answer) { place = answer.dataset.answer; want = last = null; }
  }, true);
  const follow = () => {
    const answer = place && document.querySelector(`[data-answer=${place}]`);
    if (answer && answer.offsetParent) {
      const box = answer.getBoundingClientRect(), at = box.top + scrollY;
      if (want === null || (at === last && performance.now() - moved < 1000))
        want = want === null ? Math.max(16, Math.min(box.top, innerHeight - box.height - 16)) : box.top;
      if (at !== last) scrollTo(0, at - want);
      last = at;
    }
    requestAnimationFrame(follow);
  };
  follow();
})();
/* The charts are drawn in one colour scheme: anew when that of the browser changes. */
matchMedia("(prefers-color-scheme: dark)").onchange = (e) => emitEvent("scheme", e.matches);
