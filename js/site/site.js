/**
 * The page of `terrainwave site`: that of a published folder, which also takes files of its visitor. What it needs
 * lies in the folder: it works offline and under a strict Content-Security-Policy.
 */
import { add, map, show, source, started, state, terrains } from "../../static/page.js";
import { roundedUp, withUnit } from "../../static/colours.js";
import { drawOn, element, featureOf, list, made } from "../../static/elements.js";
import { Places } from "../map/places.js";
import { open } from "../src/index.js";
import { describe, factsOf, isInDegrees } from "./described.js";
import { geoTiff, png } from "./files.js";
import { SIDE, mesher } from "./mesh.js";
import { prove } from "./prove.js";

const ON_MAP = {
  mesh: { type: "line", paint: { "line-color": "#102a43", "line-width": 0.7 } },
  worst: {
    type: "circle",
    paint: { "circle-color": "#d43d1a", "circle-radius": 8, "circle-stroke-color": "#fff", "circle-stroke-width": 2 },
  },
};
/** Places along each side of the map that are looked at for what is in view. */
const N_LOOKED_AT = 33;
const MOST_SAVED = 2 ** 26;
/** Of meshes, where neither heights nor their bound tell. */
const LEAST_TOLERANCE = 1e-3;
/** Terrains that stay open: the newest ones. */
const MOST_OPEN = 2;
/** By name, the newest last: { from, terrain }, a File or URL and the promise of its `Terrain`; null: closed. */
const opened = new Map();

function say(id, message, isBad = false) {
  element(id).textContent = message;
  element(id).classList.toggle("bad", isBad);
}

/** Say in `id` what fails in `work`; return what it returns, undefined where it fails. */
async function saying(id, work) {
  try {
    return await work();
  } catch (error) {
    if (error.name !== "AbortError") say(id, error.message, true);
    return undefined;
  }
}

// Open.

async function openTerrain(from, name) {
  say("said", `Opening ${name} …`);
  const terrain = await open(from).catch(({ message }) => {
    throw new Error(`${name} cannot be opened as a .twz file: ${message}`);
  });
  const described = describe(terrain, nameFor(name), terrains[0].ramps);
  keep(described.name, { from, terrain: Promise.resolve(terrain) });
  const isFile = from instanceof Blob;
  const bytes = isFile ? { size: from.size, read: (start, end) => from.slice(start, end).arrayBuffer() } : null;
  source.add({ name: described.name, url: isFile ? "" : new URL(from), described }, bytes);
  const { plane } = described;
  const where = plane && ((lon, lat) =>
    `x ${(plane.x + lon / plane.degrees).toFixed(2)}, y ${(plane.y + lat / plane.degrees).toFixed(2)}`);
  add({ ...described, ...(where && { where }) });
  say("said", plane ? "Shown on a plane, in coordinates of its own: the page knows longitudes and latitudes only." : "");
}

/** Return a name that no other terrain has. */
function nameFor(name) {
  const stem = name.replace(/\.twz$/i, "") || "terrain";
  for (let n = 1; ; n++) {
    const found = n === 1 ? stem : `${stem} (${n})`;
    if (!terrains.some((terrain) => terrain.name === found)) return found;
  }
}

/** Open a .twz file, and prove it by the GeoTIFF that comes with it. */
function take(files) {
  const isRaster = ({ name }) => /\.tiff?$/i.test(name);
  const original = [...files].find(isRaster);
  return saying("said", async () => {
    for (const twz of files) if (!isRaster(twz)) await openTerrain(twz, twz.name);
    if (!original) return;
    const moved = new DataTransfer();
    moved.items.add(original);
    element("original").files = moved.files;
    element("prove").disabled = false;
    element("proving").open = true;
    await startProof();
  });
}

/** Keep a terrain open, and close those that are not the newest. */
function keep(name, entry) {
  opened.delete(name);
  opened.set(name, entry);
  for (const old of [...opened.values()].slice(0, -MOST_OPEN)) {
    old.terrain?.then((terrain) => terrain.close(), () => {}); // it may not have opened
    old.terrain = null;
  }
}

function current() {
  const { name } = state.terrain;
  const entry = opened.get(name) ?? { from: source.byName.get(name).url.href, terrain: null };
  entry.terrain ??= open(entry.from);
  keep(name, entry);
  return entry;
}

/** Return the file's name in a URL. */
function nameIn(url) {
  const name = new URL(url).pathname.split("/").at(-1);
  try {
    return decodeURIComponent(name);
  } catch {
    return name; // its % do not stand for characters
  }
}

async function shown({ detail: described }) {
  clearProof();
  drawn.mesh = null;
  for (const button of element("samples").children) button.ariaPressed = String(button.value === described.name);
  await saying("said", async () => {
    const terrain = await current().terrain;
    const root = await terrain.statedRoot();
    const isVoid = terrain.hasVoids && !(await terrain.read(0, {}, { voids: "any" })).valid.some(Boolean);
    if (state.terrain !== described) return;
    list("info", factsOf(terrain, root, isVoid));
    element("level").replaceChildren(...Array.from({ length: terrain.nLevels }, (_, k) => {
      const { nRows, nCols } = terrain.shape(k);
      return new Option(`${k}: ${nRows} × ${nCols}`, k);
    }));
    element("level").value = terrain.nLevels - 1;
  });
}

// Lines and points on the map: a new style drops them.

const drawn = { mesh: null, worst: null };

function draw(id, feature) {
  drawn[id] = feature;
  drawOn(map, id, ON_MAP[id], feature);
}

// The part in view.

/** Return [west, south, east, north] of the terrain in view. */
function boundsInView() {
  const view = map.getBounds();
  const [west, south, east, north] = state.terrain.bounds;
  const found = [Math.max(west, view.getWest()), Math.max(south, view.getSouth()),
    Math.min(east, view.getEast()), Math.min(north, view.getNorth())];
  if (found[0] >= found[2] || found[1] >= found[3]) throw new Error("no part of the terrain is in view: move the map to it");
  return found;
}

const along = (from, to, n) => Array.from({ length: n }, (_, i) => from + ((to - from) * i) / (n - 1));

/** Return the window of a level, { row, col, nRows, nCols }, in view. */
function windowInView(terrain, level) {
  const [west, south, east, north] = boundsInView();
  const { rows, cols } = new Places(state.terrain.placed, terrain)
    .toSamples(along(west, east, N_LOOKED_AT), along(south, north, N_LOOKED_AT));
  const step = 2 ** (terrain.nLevels - 1 - level);
  const shape = terrain.shape(level);
  const span = (places, n, round) => {
    const known = places.filter((place) => !Number.isNaN(place));
    if (!known.length) throw new Error("no part of the terrain is in view: move the map to it");
    const held = (place) => Math.min(Math.max(place, 0), n - 1);
    if (round) return [0, n];
    const [first, last] = [Math.min(...known), Math.max(...known)].map((place) => place / step);
    return [held(Math.floor(first)), held(Math.ceil(last)) - held(Math.floor(first)) + 1];
  };
  const [row, nRows] = span(rows, shape.nRows, false);
  const [col, nCols] = span(cols, shape.nCols, state.terrain.placed.goes_round);
  return { row, col, nRows, nCols };
}

/** Return the longitude and latitude of a sample: the nearest of many places, again and again closer. */
function lonLatOf(terrain, { row, col }) {
  const places = new Places(state.terrain.placed, terrain);
  let [west, south, east, north] = state.terrain.bounds;
  let best = null;
  for (let round = 0; round < 8; round++) {
    const [lons, lats] = [along(west, east, N_LOOKED_AT), along(south, north, N_LOOKED_AT)];
    const { rows, cols } = places.toSamples(lons, lats);
    let least = Infinity;
    for (let i = 0; i < rows.length; i++) {
      const far = Math.hypot(rows[i] - row, cols[i] - col);
      if (far < least) [least, best] = [far, [lons[i % N_LOOKED_AT], lats[Math.floor(i / N_LOOKED_AT)]]];
    }
    const [wide, high] = [(east - west) / 8, (north - south) / 8];
    [west, south, east, north] = [best[0] - wide, best[1] - high, best[0] + wide, best[1] + high];
  }
  return best;
}

async function save() {
  say("saved", "Reading …");
  const { name } = state.terrain;
  const terrain = await current().terrain;
  const level = Number(element("level").value);
  const window = windowInView(terrain, level);
  if (window.nRows * window.nCols > MOST_SAVED) {
    throw new Error(`${window.nRows} × ${window.nCols} samples are in view, expected at most ${MOST_SAVED}: move closer, or take a coarser level`);
  }
  const found = await terrain.read(level, window);
  const format = element("format").value;
  const { parts, nodata } = format === "tif" ? geoTiff(terrain, found, isInDegrees(terrain))
    : { parts: await png(terrain, found), nodata: terrain.nodata };
  const link = made("a", { href: URL.createObjectURL(new Blob(parts)), download: `${name}.${format}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  const isNamed = format !== "tif" || terrain.crs === null || /^EPSG:\d+$/.test(terrain.crs);
  say("saved", `${link.download}: ${window.nRows} × ${window.nCols} samples${isNamed ? "" : ", without the CRS, which has no EPSG code"}`
    + (Object.is(nodata, terrain.nodata) ? "" : `; voids are ${nodata}, which the file declares as nodata`));
}

// The mesh.

let surface = null; // of the view: { mesh, bounds, others }
let wanted = 0;

async function meshView() {
  if (!element("meshing").open) return;
  const mine = ++wanted;
  await saying("meshed", async () => {
    const [west, south, east, north] = boundsInView();
    say("meshed", "Reading …");
    const { known } =
      await source.maker.ask(source.byName.get(state.terrain.name), "surface", [[west, south, east, north], SIDE]);
    if (mine !== wanted) return;
    surface = { mesh: mesher(known), west, south, east, north };
    showMesh();
  });
}

function showMesh() {
  if (!surface) return;
  const { lowest, highest, error } = state.terrain;
  const least = Math.max(error, (highest - lowest) / 1e4) / 4 || LEAST_TOLERANCE;
  const most = Math.max((highest - lowest) / 5, least);
  const tolerance = least * (most / least) ** (Number(element("coarseness").value) / 100);
  const { mesh, west, south, east, north } = surface;
  const { lines, nTriangles, error: measured, nOutside } = mesh(tolerance);
  const place = ([col, row]) => [west + ((east - west) * col) / (SIDE - 1), north - ((north - south) * row) / (SIDE - 1)];
  const written = (number) => withUnit(roundedUp(number, 3), state.terrain);
  element("tolerance").value = written(tolerance);
  draw("mesh", featureOf("MultiLineString", lines.map((line) => line.map(place))));
  const outside = nOutside ? ` ${nOutside.toLocaleString("en")} valid samples at voids are outside of the mesh.` : "";
  say("meshed", (nTriangles
    ? `${nTriangles.toLocaleString("en")} triangles, at most ${written(measured)} from the heights of the view under them, at ${SIDE} × ${SIDE} places.`
    : "No triangle lies between valid samples.")
    + outside + (lines.length || !nTriangles ? "" : " They are too many to draw: move closer, or raise the tolerance."));
}

// Prove.

let proof = new AbortController();

function clearProof() {
  proof.abort();
  draw("worst", null);
  for (const id of ["problems", "proof"]) element(id).replaceChildren();
  for (const id of ["where", "errors", "progress", "cancel"]) element(id).hidden = true;
  say("proved", "");
}

async function startProof() {
  const described = state.terrain;
  clearProof();
  proof = new AbortController();
  const { signal } = proof;
  const [{ from, terrain }, tif] = [current(), element("original").files[0]];
  element("progress").value = 0;
  element("progress").hidden = element("cancel").hidden = false;
  say("proved", `Comparing ${described.name} with ${tif.name} …`);
  let told = 0;
  const onProgress = (share) => {
    element("progress").value = share;
    if (share < told + 0.1) return; // or a screen reader reads on and on
    told = share;
    say("proved", `${Math.floor(100 * share)} % of the samples compared`);
  };
  const report = await saying("proved", async () =>
    prove({ twz: from, tif, band: Number(element("band").value) }, onProgress, signal));
  if (signal.aborted && signal === proof.signal && described === state.terrain && !report) say("proved", "Cancelled.");
  if (signal === proof.signal) element("progress").hidden = element("cancel").hidden = true;
  if (!report || signal.aborted) return;
  await showProof(await terrain, described, report);
}

async function showProof(terrain, described, { nValid, maxError, rmse, worst, bars, problems, stated, root, isSideUnknown }) {
  const inUnits = (number) => withUnit(Number(number.toPrecision(4)), { units: terrain.units });
  const atMost = (number) => withUnit(roundedUp(number, 4), { units: terrain.units });
  const side = isSideUnknown ? " The side of the bound was not checked: the page cannot tell if the CRS counts depths. `terrainwave verify` can." : "";
  const all = nValid ? `all ${nValid.toLocaleString("en")} samples are within ${atMost(terrain.effectiveBound)} of the original.`
    : "all samples are void in both.";
  say("proved", (problems.length ? "Not proved. Found:" : `Proved: ${all}`) + side, problems.length > 0);
  element("problems").replaceChildren(...problems.map((problem) => made("li", {}, problem)));
  const heights = worst ? [worst.original, worst.decoded].map((raw) => raw * terrain.scale + terrain.offset) : [];
  // As many digits as tell them apart by their error.
  const digits = [4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16].find((n) =>
    heights.every((height) => Math.abs(Number(height.toPrecision(n)) - height) <= maxError / 100)) ?? 17;
  const [one, other] = heights.map((height) => withUnit(Number(height.toPrecision(digits)), terrain));
  list("proof", [
    ["Largest error", worst ? `${atMost(maxError)} at row ${worst.row}, column ${worst.col}: ${other} for ${one}` : "0: all samples are equal"],
    ["Root mean square error", inUnits(rmse)],
    ["Root of the decoded heights", root],
    ["Root that the file states", stated === null ? "none" : stated === root ? "the same" : stated],
  ]);
  element("where").hidden = !worst;
  if (worst) {
    const coordinates = lonLatOf(terrain, worst);
    element("where").onclick = () => map.jumpTo({ center: coordinates, zoom: described.maxzoom });
    draw("worst", featureOf("Point", coordinates));
  }
  showBars(bars, inUnits);
}

function showBars(bars, inUnits) {
  const most = Math.max(...bars.map(({ n }) => n), 1);
  const width = 200 / bars.length;
  element("bars").replaceChildren(...bars.map(({ n }, i) => {
    const bar = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    const height = (60 * n) / most;
    const sides = { x: i * width, y: 60 - height, width: width * 0.9, height };
    for (const [name, value] of Object.entries(sides)) bar.setAttribute(name, value);
    return bar;
  }));
  const [low, high] = [bars[0].from, bars.at(-1).to];
  const middle = bars[(bars.length - 1) / 2].n;
  element("bars").ariaLabel = `Histogram of decoded minus original, ${inUnits(low)} to ${inUnits(high)}: ${middle} samples around 0, at most ${most} in a bar`;
  const written = bars.length > 1 ? [inUnits(low), "decoded − original", inUnits(high)] : ["0"];
  element("scale").replaceChildren(...written.map((text) => made("span", {}, text)));
  element("errors").hidden = false;
}

// All that can be done.

function connect() {
  element("samples").replaceChildren(...terrains.map(({ name }) => {
    const button = made("button", { type: "button", value: name }, name);
    button.addEventListener("click", () => show(terrains.find((terrain) => terrain.name === name)));
    return button;
  }));
  document.body.addEventListener("show", shown);
  map.on("style.load", () => Object.entries(drawn).forEach(([id, data]) => draw(id, data)));
  map.on("moveend", () => meshView());
  element("meshing").addEventListener("toggle", () => (element("meshing").open ? meshView() : draw("mesh", null)));
  element("coarseness").addEventListener("input", () => requestAnimationFrame(showMesh));
  element("file").addEventListener("change", ({ target }) => take(target.files));
  element("fetching").addEventListener("submit", (event) => {
    event.preventDefault();
    const url = element("url").value;
    saying("said", () => openTerrain(url, nameIn(url)));
  });
  element("save").addEventListener("click", () => saying("saved", save));
  element("original").addEventListener("change", ({ target }) => { element("prove").disabled = !target.files.length; });
  element("prove").addEventListener("click", startProof);
  element("cancel").addEventListener("click", () => proof.abort());
  for (const event of ["dragenter", "dragover", "dragleave", "drop"]) {
    document.addEventListener(event, (dragged) => {
      dragged.preventDefault();
      document.body.classList.toggle("dropping", event === "dragenter" || event === "dragover");
      if (event === "drop") take(dragged.dataTransfer.files);
    });
  }
}

await started;
connect();
if (state.terrain) shown({ detail: state.terrain });
