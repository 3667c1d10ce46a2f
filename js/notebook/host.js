/**
 * Answers to the page in a notebook, where it runs in a frame of widget.js: the terrain, the camera
 * and the window that the kernel has. It has the place of the page's host.js.
 */

import { TileMaker } from "../terrainwave/map/maplibre.js";
import { drawOn, element, featureOf, made } from "./elements.js";
import { open } from "./making.js";

const { model, terrain, source, kernel } = window.frameElement.terrainwave;
const LINE = { type: "line", paint: { "line-color": "#d43d1a", "line-width": 3 } };

export function listed(maplibre) {
  const maker = new TileMaker();
  maker.bring(terrain.name, source);
  const opened = open(maplibre, [{ name: terrain.name, url: "", described: terrain }], maker);
  return { terrains: [terrain], source: { ...opened, addressesOf: () => [] } };
}

// The camera, as the kernel has it.

let kept = null;

export function view() {
  const camera = model.get("camera");
  if (camera === null) return {};
  const { lon, lat, zoom, pitch, bearing } = camera;
  return { view: { center: [lon, lat], zoom, pitch, bearing } };
}

const isSame = (camera) => camera && Object.entries(kept).every(([name, value]) => camera[name] === value);

export function keep(_, map) {
  const { lng, lat } = map.getCenter().wrap();
  const rounded = (value, digits) => Number(value.toFixed(digits));
  kept = {
    lon: rounded(lng, 7), lat: rounded(lat, 7), zoom: rounded(map.getZoom(), 4),
    pitch: rounded(map.getPitch(), 3), bearing: rounded(map.getBearing(), 3),
  };
  if (isSame(model.get("camera"))) return;
  model.set("camera", kept);
  model.save_changes();
}

export function follow(callback) {
  listen("change:camera", () => {
    if (!kept || !isSame(model.get("camera"))) callback();
  });
}

/** Hear of the model for as long as this page is shown. */
function listen(event, callback) {
  model.on(event, callback);
  window.addEventListener("pagehide", () => model.off(event, callback));
}

// The window, drawn as a box of longitudes and latitudes; the kernel says which samples that are.

let map = null;
let start = null; // where the pointer went down
let isDrawing = false;

const button = made("button", { id: "draw", type: "button" }, "Draw a window");
const clear = made("button", { id: "clear", type: "button" }, "Clear");
const told = made("small", { id: "window", role: "status" });

export function begin(shown) {
  map = shown;
  element("fly").closest("p").after(made("p", { className: "row" }, button, clear), told);
  element("sharing").hidden = true; // there are no addresses
  button.addEventListener("click", () => setDrawing(!isDrawing));
  clear.addEventListener("click", () => send(null));
  map.on("style.load", showWindow);
  for (const event of ["mousedown", "touchstart"]) map.on(event, down);
  for (const event of ["mousemove", "touchmove"]) map.on(event, move);
  for (const event of ["mouseup", "touchend"]) map.on(event, up);
  listen("change:_window", showWindow);
}

function setDrawing(is) {
  isDrawing = is;
  start = null;
  button.ariaPressed = String(is);
  map.getCanvas().style.cursor = is ? "crosshair" : "";
  if (is) told.textContent = "Drag over the terrain.";
}

function down(event) {
  if (!isDrawing || event.originalEvent.touches?.length > 1) return;
  event.preventDefault(); // the map stays where it is
  start = event.lngLat;
}

function move({ lngLat }) {
  if (start) outline(cornersOf(start, lngLat));
}

function up({ lngLat }) {
  if (!start) return;
  const [[west, south], , [east, north]] = cornersOf(start, lngLat);
  setDrawing(false);
  send([west, south, east, north]);
}

function cornersOf(one, other) {
  const [west, east] = [one.lng, other.lng].sort((a, b) => a - b);
  const [south, north] = [one.lat, other.lat].sort((a, b) => a - b);
  return [[west, south], [east, south], [east, north], [west, north], [west, south]];
}

async function send(box) {
  told.textContent = "…";
  try {
    await kernel.ask("draw", { box });
    showWindow();
  } catch ({ message }) {
    showWindow();
    told.textContent = message;
  }
}

/** Show the window that the kernel has. */
function showWindow() {
  const drawn = model.get("_window");
  clear.disabled = !drawn;
  told.textContent = drawn
    ? `Window: ${drawn.n_rows} × ${drawn.n_cols} samples from row ${drawn.row}, column ${drawn.col} on`
    : "";
  outline(drawn?.outline);
}

function outline(corners) {
  drawOn(map, "window", LINE, corners && featureOf("LineString", corners));
}
