// Headline, histograms, evaluation, validity, tiles, and the report of the run.

const run = contents.run;

function showHeadline() {
  const { height, width } = run.tiles.region;
  document.title = `${contents.name}: ${search.name} intervals`;
  find("about").textContent =
    `${contents.name}, ${grouped(height)} rows by ${grouped(width)} columns, ` +
    `${search.plural} ${quantity(search.minimum)} to ${quantity(search.maximum)} ${search.unit}, matched ${run.finished.slice(0, 10)}.`;
  const { pixels: all, valid, low_confidence: low, median_interval_width: median } = run.counts;
  const figures = [
    ["valid pixels", percent(valid / all)],
    ["median interval width", median === null ? "none" : `${quantity(median * search.step)} ${search.unit}`],
    ["low confidence, of valid pixels", percent(low / valid)],
    ["time", `${fixed(run.seconds.total, 1)} s`],
  ];
  const judged = contents.evaluation?.all;
  if (judged?.count) figures.unshift(["intervals that contain the truth", percent(judged.accuracy)]);
  find("headline").append(
    ...figures.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value))),
  );
}

function showVerdict() {
  find("verdict").textContent = run.verdict;
  find("warnings").append(...run.warnings.map((line) => element("li", {}, line)));
}

function showSurface() {
  if (!contents.surface) return;
  find("surface").hidden = false;
  const { figures, maps } = contents.surface;
  const map = ({ title, png, ramp, ends }) => element("figure", {},
    element("img", { class: "relief", alt: title, src: `data:image/png;base64,${png}` }),
    element("figcaption", {}, title),
    ...(ramp.length ? [element("div", { class: "bar", style: `background: linear-gradient(to right, ${ramp})` })] : []),
    element("div", { class: "ends" }, ...ends.map((end) => element("span", {}, end))),
  );
  find("surface").append(table(["", ""], Object.entries(figures)), element("div", { class: "pair" }, ...maps.map(map)));
}

/** Draw histograms of two classes of pixels on a logarithmic axis, with a table of their counts. */
function showHistogram(place, { step, bars }, kinds, names) {
  const total = kinds.reduce((sum, [name]) => sum + bars[name].reduce((all, count) => all + count, 0), 0);
  const floor = 1e-4;
  const share = (count) => Math.log10(Math.max(count / Math.max(total, 1), floor));
  const length = bars[kinds[0][0]].length;
  const draw = (width) => {
    const axis = { across: names.across, up: "share of pixels", up_ticks: [-4, -3, -2, -1, 0], up_text: (power) => `${short(100 * 10 ** power)} %` };
    const { x, y, box, parts } = chart(width, 260, [0, length * step], [Math.log10(floor), 0], axis);
    for (const [name, , colour] of kinds) {
      const points = bars[name].flatMap((count, bar) => [bar, bar + 1].map((edge) => `${x(edge * step).toFixed(1)},${y(share(count)).toFixed(1)}`));
      const outline = `M${x(0)},${box.bottom}L${points.join("L")}L${x(length * step)},${box.bottom}Z`;
      parts.push(svg("path", { d: outline, fill: colour, "fill-opacity": 0.35, stroke: colour, "stroke-width": 1.2 }));
    }
    if (!total) parts.push(svg("text", { x: width / 2, y: 110, "text-anchor": "middle" }, "no pixel"));
    return parts;
  };
  const rows = bars[kinds[0][0]]
    .map((_, bar) => [`${short(bar * step)} to ${short((bar + 1) * step)}`, ...kinds.map(([name]) => bars[name][bar])])
    .filter(([, ...counts]) => counts.some(Boolean));
  place.append(element("h3", { class: "first" }, names.title));
  drawing(place, 260, `${names.title}: ${grouped(total)} pixels`, draw);
  place.append(
    element("figcaption", { class: "legend" }, ...legend(kinds.map(([, text, colour]) => [text, colour]))),
    element("details", {}, element("summary", {}, "Numbers"), table([names.across, ...kinds.map(([, text]) => `${text} (pixels)`)], rows)),
  );
}

function showHistograms() {
  const { width, confidence } = contents.histograms;
  showHistogram(find("widths"), width, [["high", "high confidence", "var(--band)"], ["low", "low confidence", "var(--truth)"]], {
    title: "Interval width of valid pixels", across: run.sweep ? "width (m), last bar: and wider" : "width (px)",
  });
  showHistogram(find("confidences"), confidence, [["valid", "valid", "var(--band)"], ["rejected", "not valid", "var(--truth)"]], {
    title: "Confidence of searched pixels", across: "confidence",
  });
}

function showEvaluation() {
  const judged = contents.evaluation;
  if (!judged) return;
  const row = (name, figures) => [
    name, figures.count, percent(figures.accuracy),
    figures.mean_width === null ? "none" : `${fixed(figures.mean_width, 2)} px`,
    figures.interval_score === null ? "none" : `${fixed(figures.interval_score, 2)} px`,
  ];
  const rows = [row("all", judged.all), row("high confidence", judged.high), row("low confidence", judged.low)];
  const head = ["valid pixels", "count", "coverage: contain the truth", "mean width", "interval score"];
  find("evaluation").hidden = false;
  find("evaluation").append(
    element("p", {}, "Truth: ", element("code", {}, contents.truth), ". Disparity errors above 1 px: ",
      `${percent(judged.bad1)}, above 3 px: ${percent(judged.bad3)}; truths outside the search range: ${percent(judged.truth_outside_range)}.`),
    table(head, rows),
    element("p", { class: "quiet" }, "The interval score is the width, and 2 / (1 - nominal) times the distance of a missed truth. " + nominalSentence()),
  );
  if (judged.deciles.length) showDeciles(judged.deciles);
}

function nominalSentence() {
  const { coverage } = run.settings.interval;
  return coverage ? `Nominal coverage: ${percent(coverage)}, a mean over pixels like those of the calibration, not a promise for each pixel.`
    : "The level alpha is a possibility, not a guaranteed probability.";
}

/** Show how often intervals contain the truth, by decile of confidence, lowest first. */
function showDeciles(deciles) {
  const text = (group) => group.confidence.map((value) => fixed(value, 2)).join(" to ");
  find("evaluation").append(
    element("h3", {}, "By decile of confidence"),
    table(["confidence", "count", "accuracy", "mean width"], deciles.map((group) => [
      text(group), group.count, shareCell(group.accuracy, 120), `${fixed(group.mean_width, 2)} px`,
    ])),
  );
}

function shareCell(share, longest) {
  return element("span", {}, percent(share), element("i", { class: "share", style: `width: ${Math.round(longest * (share ?? 0))}px` }));
}

function showValidity() {
  const { pixels: all, valid, flags, causes } = run.counts;
  const rows = Object.entries(run.validity_bits).map(([name, flag]) => [
    String(flag.bit), name.replaceAll("_", " "), flag.meaning, flags[name], flag.invalid ? shareCell(causes[name] / all, 120) : "",
  ]);
  find("validity").append(
    element("p", {}, `${percent(valid / all)} of ${grouped(all)} pixels are valid. A pixel may have several flags; the first ` +
      "that makes it invalid is its cause. Valid pixels and causes add up to 100 %."),
    table(["bit", "flag", "meaning", "pixels with the flag", "cause, of all pixels"], rows),
  );
}

/** Show what was found of many images: heights, shifts of their models, likeness. */
function showSweep() {
  const { images, left_out: out, step, crs, cells } = run.sweep;
  find("search-title").textContent = "Images and heights";
  const rows = images.map(({ path, shift, left, alike }) =>
    [path.split("/").at(-1), ...[...shift, left, alike].map((value) => value === null ? "-" : fixed(value, 2))]);
  find("search").append(
    element("p", {}, `Heights ${quantity(search.minimum)} to ${quantity(search.maximum)} m, every ${fixed(step, 2)} m, ` +
      `for cells of ${short(cells.resolution)} m in ${crs}. Left out: ${out.length ? out.join(", ") : "no image"}.`),
    table(["image", "shift of its model, rows of the image", "columns", "what they leave", "likeness to the others (\u22121 to 1)"], rows),
  );
}

function showSearch() {
  if (run.sweep) {
    showSweep();
    return;
  }
  const { valid, range_ends: ends } = run.counts;
  const { search: found, local_ranges: local, quality } = run;
  const place = find("search");
  const origin = found ? `found from matches on ${percent(found.matched)} of the pixels` : "given";
  place.append(element("p", {}, `Disparities ${short(search.minimum)} to ${short(search.maximum)} px, ${origin}` +
    `${local ? `; each cell searches ${percent(local.share)} of them on average, see the map` : ""}. Of the valid pixels, ` +
    `${percent(ends.minimum / valid)} are within 1 px of the minimum and ${percent(ends.maximum / valid)} of the maximum.`));
  const rows = [
    ["distance of matches, 1 = random pixels", quality.noise === null ? "none" : fixed(quality.noise, 2)],
    ["rows of the two images", run.survey?.rows ? rowsSentence(run.survey.rows) : "not compared"],
    ...Object.entries(quality.undeclared).map(([side, undeclared_border]) => [`border of the ${side} image`, `${percent(undeclared_border.share)} of its pixels are ${short(undeclared_border.value)}`]),
  ];
  place.append(table([], rows));
  if (run.survey?.rows) showRows(place, run.survey.rows);
}

function rowsSentence({ before: [median], after: [left] }) {
  const moved = run.rows ? `, ${fixed(left, 2)} px after they were moved` : "";
  return `differ by ${fixed(median, 2)} px in the median${moved}`;
}

/** Draw the row offsets of the places that were compared, and what the function leaves of them, as numbers. */
function showRows(place, { samples }) {
  const done = run.rows ? "taken out of the right image" : "left as they are";
  const figures = [[2, `Row offset (px), ${done}`], [3, "What a smooth function leaves of it (px)"]].map(([part, title]) => {
    const figure = element("figure", {}, element("h3", {}, title));
    drawing(figure, 260, title, (width) => {
      const { width: across, height } = run.inputs.right;
      const { x, y, parts } = chart(width, 260, [0, across], [height, 0], { across: "column", up: "row", up_ticks: ticks(0, height, 5) });
      return [...parts, ...samples.map((sample) => svg("text", { x: x(sample[1]), y: y(sample[0]) + 4, "text-anchor": "middle" }, fixed(sample[part], 2)))];
    });
    return figure;
  });
  place.append(element("div", { class: "pair" }, ...figures));
}

function showTiles() {
  const { rows, columns, size, overlap } = run.tiles;
  const place = find("tiles");
  if (rows * columns === 1) {
    place.append(element("p", {}, `One tile of at most ${size} x ${size} pixels: no seams.`));
    return;
  }
  const count = `${grouped(rows * columns)} tiles of ${size} x ${size} pixels`;
  const figure = element("figure", { style: "max-width: 420px" });
  place.append(
    element("p", {}, overlap === "exact" ? `${count}, which hand path states to their neighbours: no seams.` :
      `${count}, read with an overlap of ${overlap} px.`),
    figure,
  );
  drawing(figure, tilesHeight(420), "Grid of tiles", drawTiles);
}

const tilesHeight = (width) => Math.min(420, Math.max(60, Math.round((width * run.tiles.region.height) / run.tiles.region.width)));

/** Draw the borders of the tiles. */
function drawTiles(wide) {
  const { rows, columns, size, region: { height, width } } = run.tiles;
  const tall = tilesHeight(420);
  const x = (column) => (wide * Math.min(column * size, width)) / width;
  const y = (row) => (tall * Math.min(row * size, height)) / height;
  const line = (x1, y1, x2, y2, more) => svg("line", { x1, y1, x2, y2, class: "axis", ...more });
  const parts = [svg("rect", { width: wide, height: tall, fill: "var(--soft)" })];
  for (let column = 0; column <= columns; column++) parts.push(line(x(column), 0, x(column), tall));
  for (let row = 0; row <= rows; row++) parts.push(line(0, y(row), wide, y(row)));
  return parts;
}

function showRun() {
  const place = find("run");
  const words = (value) => (typeof value !== "object" ? String(value) : value.levels ? value.name : JSON.stringify(value)); // a calibration
  const given = (values) => Object.entries(values).filter(([, value]) => value !== null && value.length !== 0);
  const section = ([name, values]) => (values === null || typeof values !== "object"
    ? [[name, values ?? "off", ""]]
    : given(values).map(([key, value], i) => [i ? "" : name, key, words(value)]));
  const seconds = Object.entries(run.seconds).map(([stage, value]) => [
    stage.includes(".") ? `${stage.replace(".", ", ")} (sum over workers)` : stage, `${fixed(value, 2)} s`,
  ]);
  const inputs = Object.entries(run.inputs).flatMap(([side, input]) =>
    given(input).map(([key, value], i) => [i ? "" : side, key, key === "mask" ? value.path : words(value)]));
  const columns = element("div", { class: "pair" },
    element("div", {}, element("h3", {}, "Settings"), table([], Object.entries(run.settings).flatMap(section))),
    element("div", {}, element("h3", {}, "Times"), table([], seconds), element("h3", {}, "Versions"), table([], Object.entries(run.versions))));
  place.append(columns, element("h3", {}, "Inputs"), table([], inputs), element("p", { class: "quiet" }, "Settings without a value are left out."));
}

explore().catch((error) => {
  find("loading").textContent = `The map cannot be drawn: ${error.message}. Use a browser of 2023 or later.`;
  throw error;
});
showHeadline();
showVerdict();
showHistograms();
showEvaluation();
showSurface();
showValidity();
showSearch();
showTiles();
showRun();
