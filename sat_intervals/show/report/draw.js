"use strict";
// Shared by the other scripts: elements, number formats, axes, legends and tables.

const contents = JSON.parse(document.getElementById("contents").textContent);
const find = (id) => document.getElementById(id);

/** Make an HTML element with attributes and children (elements or text). */
function element(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

/** Make an SVG element. */
function svg(name, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children.filter((child) => child !== null));
  return node;
}

const grouped = (value) => value.toLocaleString("en-US");
const fixed = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "none");
const short = (value) => String(Number(value.toPrecision(6))).replace("-", "\u2212");

/** Format a share (0 to 1) as a percentage, small ones with more digits; "none" if it is missing. */
function percent(share) {
  if (share === null || !Number.isFinite(share)) return "none";
  const value = 100 * share;
  return `${value === 0 || value >= 0.1 ? value.toFixed(1) : value.toPrecision(2)} %`;
}

/** Return about `count` round numbers between two values. */
function ticks(first, last, count) {
  const raw = (last - first) / count || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw);
  const found = [];
  for (let value = Math.ceil(first / step - 1e-9); value * step <= last + 1e-9 * step; value++) found.push(value * step);
  return found;
}

/** Add a drawing as wide as its parent, redrawn when that changes; `draw(width)` returns its children. */
function drawing(place, height, label, draw) {
  const picture = svg("svg", { role: "img", "aria-label": label, height });
  place.append(picture);
  const redraw = () => {
    const width = Math.max(280, place.clientWidth);
    picture.setAttribute("viewBox", `0 0 ${width} ${height}`);
    picture.replaceChildren(...draw(width));
  };
  new ResizeObserver(redraw).observe(place);
  return redraw;
}

/** Return the scales of a chart (functions from values to positions) and the elements of its axes. */
function chart(width, height, across, up, names) {
  const box = { left: 58, right: width - 8, top: 8, bottom: height - 38 };
  const x = (value) => box.left + ((value - across[0]) / (across[1] - across[0])) * (box.right - box.left);
  const y = (value) => box.bottom - ((value - up[0]) / (up[1] - up[0])) * (box.bottom - box.top);
  const parts = [];
  for (const value of names.up_ticks ?? ticks(up[0], up[1], height / 55)) {
    parts.push(svg("line", { class: "grid", x1: box.left, x2: box.right, y1: y(value), y2: y(value) }));
    const text = names.up_text ? names.up_text(value) : short(value);
    parts.push(svg("text", { x: box.left - 8, y: y(value) + 4, "text-anchor": "end" }, text));
  }
  for (const value of ticks(across[0], across[1], (box.right - box.left) / 90)) {
    parts.push(svg("line", { class: "axis", x1: x(value), x2: x(value), y1: box.bottom, y2: box.bottom + 4 }));
    parts.push(svg("text", { x: x(value), y: box.bottom + 18, "text-anchor": "middle" }, short(value)));
  }
  parts.push(svg("line", { class: "axis", x1: box.left, x2: box.right, y1: box.bottom, y2: box.bottom }));
  parts.push(svg("text", { x: (box.left + box.right) / 2, y: height - 3, "text-anchor": "middle" }, names.across));
  const middle = (box.top + box.bottom) / 2;
  const turned = { x: 13, y: middle, "text-anchor": "middle", transform: `rotate(-90 13 ${middle})` };
  parts.push(svg("text", turned, names.up));
  return { x, y, box, parts };
}

/** Make the entries of a legend from `[text, colour, whether a line]`. */
function legend(entries) {
  return entries.map(([text, colour, line]) => {
    const style = line ? `border-color: ${colour}` : `background: ${colour}`;
    return element("span", {}, element("span", { class: line ? "swatch line" : "swatch", style }), text);
  });
}

/** Make a table; cells are text, numbers (aligned right) or elements. */
function table(head, rows) {
  const cell = (value, kind) => {
    const number = typeof value === "number";
    return element(kind, number ? { class: "number" } : {}, number ? grouped(value) : value);
  };
  const row = (cells) => element("tr", {}, ...cells.map((value, place) => cell(value, place ? "td" : "th")));
  const numbers = head.map((_, place) => typeof rows[0]?.[place] === "number");
  const names = head.map((text, place) => element("th", numbers[place] ? { class: "number" } : {}, text));
  const top = head.length ? element("thead", {}, element("tr", {}, ...names)) : null;
  return element("div", { class: "scroll" }, element("table", {}, top, element("tbody", {}, ...rows.map(row))));
}
