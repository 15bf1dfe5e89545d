// The slider over focal lengths: a bent grid, the displacement along the radius, and the nearest photo.
(() => {
  const data = JSON.parse(document.getElementById("lens-data").textContent);
  const part = (name) => document.getElementById(name);
  const input = part("zoom-at");
  const ns = "http://www.w3.org/2000/svg";
  const path = (points, x, y) => {
    let text = "", pen = "M";
    for (const [px, py] of points) {
      if (px === null || py === null) { pen = "M"; continue; }
      text += `${pen}${x(px).toFixed(1)} ${y(py).toFixed(1)}`;
      pen = "L";
    }
    return text;
  };
  const add = (parent, kind, attributes, text) => {
    const element = document.createElementNS(ns, kind);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text !== undefined) element.textContent = text;
    parent.append(element);
    return element;
  };

  // The grid, in a picture 480 wide with room for what bends outwards.
  const grid = part("zoom-grid"), wide = 480, scale = wide / data.size[0], tall = data.size[1] * scale;
  grid.setAttribute("viewBox", `${-0.06 * wide} ${-0.06 * wide} ${1.12 * wide} ${tall + 0.12 * wide}`);
  const at = (value) => value * scale;
  for (const line of data.straight) add(grid, "path", { d: path(line, at, at), class: "straight" });
  const bent = data.straight.map(() => add(grid, "path", { class: "bent" }));

  // The curve: displacement against radius, all focal lengths pale, the chosen one in colour.
  const curve = part("zoom-curve"), box = { left: 52, right: 470, top: 12, bottom: 262 };
  const radii = data.radius, last = radii[radii.length - 1];
  const known = data.moved.flat().filter((value) => value !== null);
  const most = 1.5 * Math.max(0, ...known.map(Math.abs));  // of bands, which may be far wider than the curves
  data.moved.forEach((row, index) => row.forEach((value, at) => {
    const std = data.std[index][at];
    if (value === null || std === null) return;
    for (const end of [value - 2 * std, value + 2 * std]) known.push(Math.min(most, Math.max(-most, end)));
  }));
  let low = Math.min(0, ...known), high = Math.max(0, ...known);
  if (high - low < 1e-9) high = low + 1;
  const margin = 0.06 * (high - low);
  low -= margin; high += margin;
  const x = (value) => box.left + (box.right - box.left) * value / last;
  const y = (value) => box.bottom - (box.bottom - box.top) * (value - low) / (high - low);
  const step = 10 ** Math.floor(Math.log10((high - low) / 3));
  const tick = [1, 2, 5, 10].map((times) => times * step).find((size) => (high - low) / size <= 6);
  for (let value = Math.ceil(low / tick) * tick; value <= high; value += tick) {
    const text = Math.abs(value) < tick / 2 ? "0" : String(Number(value.toPrecision(6)));
    add(curve, "path", { d: `M${box.left} ${y(value)}H${box.right}`, class: text === "0" ? "axis" : "rule" });
    add(curve, "text", { x: box.left - 6, y: y(value) + 4, "text-anchor": "end" }, text.replace("-", "−"));
  }
  for (const share of [0, 0.5, 1]) {
    const anchor = share === 1 ? "end" : "middle";
    add(curve, "text", { x: x(share * last), y: box.bottom + 18, "text-anchor": anchor }, Math.round(share * last));
  }
  add(curve, "text", { x: (box.left + box.right) / 2, y: box.bottom + 36, "text-anchor": "middle" },
    "px from the centre");
  add(curve, "text", { x: 12, y: (box.top + box.bottom) / 2, "text-anchor": "middle",
    transform: `rotate(-90 12 ${(box.top + box.bottom) / 2})` }, "px moved outwards");
  data.moved.forEach((row, index) => {
    if (index % 5 === 0) add(curve, "path", { d: path(row.map((v, i) => [radii[i], v]), x, y), class: "pale" });
  });
  const band = add(curve, "path", { class: "band" }), bold = add(curve, "path", { class: "bent" });

  const photos = [...document.querySelectorAll("#photos [data-focal]")];
  const show = () => {
    const index = Number(input.value), f = data.focal[index];
    data.grid[index].forEach((line, number) => bent[number].setAttribute("d", path(line, at, at)));
    const row = data.moved[index], std = data.std[index];
    bold.setAttribute("d", path(row.map((v, i) => [radii[i], v]), x, y));
    const sure = row.every((v, i) => v !== null && std[i] !== null);
    const clip = (value) => Math.min(high, Math.max(low, value));
    const upper = row.map((v, i) => [radii[i], clip(v + 2 * std[i])]);
    const lower = row.map((v, i) => [radii[i], clip(v - 2 * std[i])]).reverse();
    band.setAttribute("d", sure ? `${path([...upper, ...lower], x, y)}Z` : "");
    const moved = row[row.length - 1], digits = Math.abs(moved) < 10 ? 2 : 1;
    const text = moved === null ? "the image folds over in the corner"
      : `the corner moves by ${Math.abs(moved).toFixed(digits)} px ${moved < 0 ? "inwards" : "outwards"}`;
    const label = `f = ${Number(f.toPrecision(4))} ${data.unit}: ${text}`;
    part("zoom-label").textContent = label;
    input.setAttribute("aria-valuetext", label);
    if (photos.length) {
      const away = (photo) => Math.abs(1 / photo.dataset.focal - 1 / f);
      const nearest = photos.reduce((best, photo) => (away(photo) < away(best) ? photo : best));
      const sources = nearest.querySelectorAll(".pair img");
      part("zoom-before").src = sources[0].src;
      part("zoom-after").src = sources[1].src;
      part("zoom-photo").textContent =
        `The nearest photo: ${nearest.dataset.name}, f = ${nearest.dataset.focal} ${data.unit}`;
    }
  };
  input.max = data.focal.length - 1;
  input.addEventListener("input", show);
  part("zoom-tool").hidden = false;
  show();
})();
