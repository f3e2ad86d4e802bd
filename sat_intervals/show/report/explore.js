// The map, its layers, and the profile of the selected row.

const pixels = contents.pixels;
const search = contents.quantity; // disparities in pixels, or heights in metres
const quantity = (value) => (contents.run.sweep ? fixed(value, 2) : short(value));
const titled = (text) => text[0].toUpperCase() + text.slice(1);
const COLOURS = {
  grey: ["#000000", "#ffffff"],
  viridis: ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"],
  magma: ["#000004", "#1d1147", "#51127c", "#832681", "#b73779", "#e75263", "#fc8961", "#fec488", "#fcfdbf"],
  cividis: ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838"],
};
const STRETCHED = 5; // largest ratio of the sides of the map; pixels of longer ones are not square
const NOTHING = "#dedede";
const MISSES = [["truth above the interval", "#d55e00"], ["truth below the interval", "#56b4e9"]];
const hasIntervals = contents.run.settings.interval !== null;
const WIDEST = 0.9; // quantile of the widths at the end of their scale
const data = {}; // values of each layer, row by row
const selected = { row: 0, column: 0 };

/** Decode a layer; NaN means a missing value. */
async function unpacked({ first, step, bits, codes }) {
  const packed = Uint8Array.from(atob(codes), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = await new Response(stream).arrayBuffer();
  const read = bits === 8 ? new Uint8Array(bytes) : new Uint16Array(bytes);
  return Float32Array.from(read, (code) => (code === 2 ** bits - 1 ? NaN : first + code * step));
}

const rgb = (colour) => [1, 3, 5].map((start) => parseInt(colour.slice(start, start + 2), 16));

/** Return a function from a position on a colour scale (0 to 1) to red, green and blue. */
function scaleOf(stops) {
  const ends = stops.map(rgb);
  const shades = Array.from({ length: 256 }, (_, step) => {
    const at = (step / 255) * (ends.length - 1);
    const below = Math.min(Math.floor(at), ends.length - 2);
    return ends[below].map((value, i) => value + (ends[below + 1][i] - value) * (at - below));
  });
  const nothing = rgb(NOTHING);
  return (place) => (Number.isFinite(place) ? shades[Math.round(255 * Math.min(Math.max(place, 0), 1))] : nothing);
}

/** Return quantiles of the finite values; undefined if there are none. */
function quantiles(values, ...shares) {
  const known = values.filter(Number.isFinite).sort();
  return shares.map((share) => known[Math.round(share * (known.length - 1))]);
}

/** Return percentiles 1 and 99 of the values. */
function limits(values, otherwise) {
  const [low, high] = quantiles(values, 0.01, 0.99);
  if (low === undefined) return otherwise;
  return low < high ? [low, high] : [low - 0.5, high + 0.5];
}

/** Return the layers of the map: name, values, and colour scale or classes with colours. */
function makeLayers() {
  const { first, step } = pixels.layers.image;
  const width = data.upper.map((upper, i) => upper - data.lower[i]);
  const layers = [
    { name: contents.run.sweep ? "Hillshade" : "Left image", values: data.image, colours: COLOURS.grey, shown: [first, first + 254 * step] },
    { name: titled(search.name), unit: search.unit, values: data.disparity, colours: COLOURS.viridis,
      shown: limits(data.disparity, [search.minimum, search.maximum]) },
    { name: "Confidence", values: data.confidence, colours: COLOURS.cividis, shown: [0, 1] },
    { name: "Validity", values: data.kind, kinds: pixels.kinds.map((kind) => [kind.meaning, kind.colour]), counts: contents.classes },
  ];
  if (hasIntervals) {
    const shown = [0, quantiles(width, WIDEST)[0] || 1];
    layers.splice(2, 0, { name: "Interval width", unit: `${search.unit}, square-root scale`, values: width, colours: COLOURS.magma, shown, power: 0.5 });
  }
  if (data.searched) layers.push({ name: `${titled(search.plural)} searched`, unit: contents.run.sweep ? "m" : "count", values: data.searched, colours: COLOURS.viridis, shown: [0, search.maximum - search.minimum + search.step] });
  if (data.truth && hasIntervals) layers.push({ name: "Misses", values: data.missed, kinds: [null, ...MISSES] });
  return layers;
}

/** Return the colour of a pixel of a layer as a function of its value and its index. */
function painter(layer) {
  if (!layer.kinds) {
    const scale = scaleOf(layer.colours);
    const place = (value) => Math.max(0, (value - layer.shown[0]) / (layer.shown[1] - layer.shown[0]));
    return (value) => scale(place(value) ** (layer.power ?? 1));
  }
  const kinds = layer.kinds.map((kind) => kind && rgb(kind[1]));
  const pale = scaleOf(["#333333", "#bbbbbb"]); // the left image where a pixel has no class
  const { first, step } = pixels.layers.image;
  return (value, i) => kinds[value] ?? pale((data.image[i] - first) / (254 * step));
}

function paint(layer) {
  const canvas = document.querySelector("#map canvas");
  const image = new ImageData(pixels.columns, pixels.rows);
  const colour = painter(layer);
  layer.values.forEach((value, i) => image.data.set([...colour(value, i), 255], 4 * i));
  canvas.getContext("2d").putImageData(image, 0, 0);
  canvas.setAttribute("aria-label", `Map: ${layer.name}`);
  find("key").replaceChildren(...keyOf(layer));
}

/** Return the key of a layer: its classes with their shares of all pixels (or of those shown), or its colour scale. */
function keyOf(layer) {
  const title = element("h3", {}, layer.unit ? `${layer.name} (${layer.unit})` : layer.name);
  if (layer.kinds) {
    const counts = layer.counts ?? layer.kinds.map((_, kind) => layer.values.reduce((sum, value) => sum + (value === kind), 0));
    const total = counts.reduce((sum, count) => sum + count, 0);
    const entries = layer.kinds.map((kind, i) => kind && [`${kind[0]} (${percent(counts[i] / total)})`, kind[1]]);
    return [title, element("div", { class: "legend" }, ...legend(entries.filter((entry, i) => entry && counts[i])))];
  }
  if (!layer.values.some(Number.isFinite)) return [title, element("p", { class: "quiet" }, "No pixel has a value.")];
  const beyond = [
    layer.values.some((value) => value < layer.shown[0]) ? "\u2264 " : "",
    layer.values.some((value) => value > layer.shown[1]) ? "\u2265 " : "",
  ];
  const ends = layer.shown.map((value, i) => element("span", {}, beyond[i] + short(+value.toFixed(1))));
  return [
    title,
    element("div", { class: "bar", style: `background: linear-gradient(to right, ${layer.colours.join(", ")})` }),
    element("div", { class: "ends" }, ...ends),
    element("div", { class: "legend" }, ...legend([["no value", NOTHING]])),
  ];
}

/** Return the selected row of a layer. */
const rowOf = (layer) => layer.subarray(selected.row * pixels.columns, (selected.row + 1) * pixels.columns);

/** Return runs `[first, end)` of consecutive values that pass a test. */
function runs(values, test) {
  const found = [];
  values.forEach((value, column) => {
    if (!test(value)) return;
    if (found.at(-1)?.[1] === column) found.at(-1)[1]++;
    else found.push([column, column + 1]);
  });
  return found;
}

/** Return the SVG path of the finite values, one step per pixel; with `back`, the area between both. */
function steps(values, back, edge, y) {
  const path = (line, first, last) =>
    Array.from(line.subarray(first, last), (value, i) => [first + i, first + i + 1].map((side) => `${edge(side)},${y(value).toFixed(1)}`)).flat();
  return runs(values, Number.isFinite)
    .map(([first, last]) => `M${path(values, first, last).concat(back ? path(back, first, last).reverse() : []).join("L")}${back ? "Z" : ""}`)
    .join("");
}

function drawProfile(width) {
  const [lower, upper, disparity, low] = [data.lower, data.upper, data.disparity, data.low].map(rowOf);
  const truth = data.truth ? rowOf(data.truth) : new Float32Array();
  const known = [...lower, ...upper, ...disparity, ...truth].filter(Number.isFinite);
  const up = known.length ? [Math.min(...known) - 1, Math.max(...known) + 1] : [search.minimum - 1, search.maximum + 1];
  const across = [-0.5 * pixels.step, (pixels.columns - 0.5) * pixels.step];
  const { x, y, box, parts } = chart(width, 320, across, up, { across: "column", up: `${search.name} (${search.unit})` });
  const edge = (column) => x((column - 0.5) * pixels.step).toFixed(1);
  const sections = runs(low, (value) => value === 1).map(([first, last]) =>
    svg("rect", { x: edge(first), y: box.top, width: edge(last) - edge(first), height: box.bottom - box.top, fill: "var(--low)" }));
  const line = (values, colour) => svg("path", { d: steps(values, null, edge, y), fill: "none", stroke: colour, "stroke-width": 1.4 });
  const mark = x(selected.column * pixels.step);
  const none = svg("text", { x: width / 2, y: 24, "text-anchor": "middle" }, "no valid pixel in this row");
  return [
    ...sections,
    ...parts,
    svg("path", { id: "band", d: steps(lower, upper, edge, y), fill: "var(--band)", "fill-opacity": 0.7 }),
    line(truth, "var(--truth)"),
    line(disparity, "var(--ink)"),
    svg("line", { x1: mark, x2: mark, y1: box.top, y2: box.bottom, stroke: "var(--quiet)", "stroke-dasharray": "3 3" }),
    ...(disparity.some(Number.isFinite) ? [] : [none]),
  ];
}

/** Describe the selected pixel in words. */
function describe() {
  const i = selected.row * pixels.columns + selected.column;
  const digits = contents.run.sweep ? 2 : 1;
  const parts = [`Row ${selected.row * pixels.step}, column ${selected.column * pixels.step}: ${pixels.kinds[data.kind[i]].meaning}`];
  if (Number.isFinite(data.disparity[i])) parts.push(`${search.name} ${fixed(data.disparity[i], 2)} ${search.unit}`);
  if (Number.isFinite(data.lower[i])) parts.push(`interval ${fixed(data.lower[i], digits)} to ${fixed(data.upper[i], digits)} ${search.unit}`);
  if (Number.isFinite(data.confidence[i])) parts.push(`confidence ${fixed(data.confidence[i], 2)}`);
  if (data.truth && Number.isFinite(data.truth[i])) parts.push(`truth ${fixed(data.truth[i], 2)} px`);
  return parts.join(", ");
}

/** Select a pixel: show the profile of its row, its values, its position on the map. */
function choose(row, column, redraw) {
  selected.row = Math.min(Math.max(row, 0), pixels.rows - 1);
  selected.column = Math.min(Math.max(column, 0), pixels.columns - 1);
  const place = { row: selected.row * pixels.step, column: selected.column * pixels.step };
  for (const name of ["row", "column"]) {
    find(name).value = selected[name];
    find(name).setAttribute("aria-valuetext", place[name]);
    find(`${name}-number`).textContent = place[name];
  }
  find("row-mark").style.top = `${(100 * (selected.row + 0.5)) / pixels.rows}%`;
  find("column-mark").style.left = `${(100 * (selected.column + 0.5)) / pixels.columns}%`;
  find("pixel").textContent = describe();
  find("command").textContent = `sat-intervals plot ${contents.folder} --row ${place.row} --pixel ${place.row} ${place.column}`;
  redraw();
}

/** Set up the map, shaped like the images unless they are thin, and its buttons. */
function showMap() {
  const map = find("map");
  Object.assign(map.firstElementChild, { width: pixels.columns, height: pixels.rows });
  const tall = Math.min(Math.max(pixels.rows / pixels.columns, 1 / STRETCHED), STRETCHED);
  map.style.aspectRatio = 1 / tall;
  map.parentElement.classList.toggle("wide", tall < 0.5);
  if (tall > 1.6) map.style.width = `${160 / tall}%`;
  find("thinned").textContent =
    (pixels.step > 1 ? `This page holds one row in ${pixels.step} and one column in ${pixels.step}. ` : "") +
    "Click on the map or move the sliders to select another row.";
  const layers = makeLayers();
  for (const layer of layers) {
    const input = element("input", { type: "radio", name: "layer", ...(layer === layers[0] && { checked: "" }) });
    input.addEventListener("change", () => paint(layer));
    find("layers").append(element("label", {}, input, element("span", {}, layer.name)));
  }
  paint(layers[0]);
}

/** Set up the profile, and the sliders and clicks that select its row. */
function showProfile() {
  const entries = [[search.name, "var(--ink)", true], ["low confidence", "var(--low)"]];
  if (hasIntervals) entries.unshift(["interval", "var(--band)"]);
  if (data.truth) entries.push(["truth", "var(--truth)", true]);
  const gaps = element("span", { class: "quiet" }, `no ${hasIntervals ? "band" : "black line"}: no valid pixel`);
  find("profile-key").append(...legend(entries), gaps);
  const redraw = drawing(find("profile"), 320, `Interval, ${search.name} and truth along the selected row`, drawProfile);
  Object.assign(find("row"), { max: pixels.rows - 1 });
  Object.assign(find("column"), { max: pixels.columns - 1 });
  for (const name of ["row", "column"]) {
    find(name).addEventListener("input", () => choose(+find("row").value, +find("column").value, redraw));
  }
  find("map").addEventListener("click", (event) => {
    const box = find("map").firstElementChild.getBoundingClientRect();
    const row = Math.floor(((event.clientY - box.top) / box.height) * pixels.rows);
    choose(row, Math.floor(((event.clientX - box.left) / box.width) * pixels.columns), redraw);
  });
  find("command").parentElement.hidden = !!contents.run.sweep;
  choose(Math.floor(pixels.rows / 2), Math.floor(pixels.columns / 2), redraw);
}

async function explore() {
  const names = Object.keys(pixels.layers);
  const layers = await Promise.all(names.map((name) => unpacked(pixels.layers[name])));
  names.forEach((name, place) => (data[name] = layers[place]));
  showMap();
  showProfile();
  find("loading").remove();
  document.documentElement.dataset.ready = "";
}
