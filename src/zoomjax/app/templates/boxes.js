// Boxes whose content goes on beyond an edge fade there, so that one sees that they scroll.
(() => {
  const mark = (box) => {
    const left = box.scrollLeft > 1, right = box.scrollWidth - box.clientWidth - box.scrollLeft > 1;
    box.classList.toggle("more-left", left);
    box.classList.toggle("more-right", right);
  };
  const boxes = [...document.querySelectorAll(".box")];
  boxes.forEach((box) => box.addEventListener("scroll", () => mark(box), { passive: true }));
  new ResizeObserver(() => boxes.forEach(mark)).observe(document.body);
  boxes.forEach(mark);
})();
