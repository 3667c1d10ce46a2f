// The page of `terrainwave serve` and `publish`: MapLibre over the tiles of one file at a time.
//
// Tiles and heights come from a server (`served.js`) or are made here (`published.js`), as `host.js`
// says.
// `state` is what the page shows. Each terrain that is shown is a new generation: what was asked
// for an earlier one (styles, heights) is dropped when it comes.
import { Map, NavigationControl, ScaleControl, addProtocol, setWorkerUrl } from "./maplibre/maplibre-gl.js";
import { gradientOf, reliefOf, roundedUp, stopsOf, ticksOf, withUnit, written } from "./colours.js";
import { copyable, element, list, made } from "./elements.js";
import { homeOf, isNarrow } from "./home.js";
import * as host from "./host.js";

// It would look for npm's name, which ends in .mjs: many hosts do not know that ending.
setWorkerUrl(String(new URL("./maplibre/maplibre-gl-worker.js", import.meta.url)));

const ASKING = "Point at the terrain or tap it for a height.";
const DEGREES_PER_SECOND = 6;
const GROUND = "#dbe4e8";
// Pixels by which tiles go on beyond the terrain, under the paint of its voids: the mesh of the map
// has a vertex at each second pixel, which reads its neighbours.
const RIM = 4;
// Of the terrain's size: how far beyond its edges tiles are asked for, because of the rim.
const AROUND = 0.02;
const MILLISECONDS_BETWEEN_HEIGHTS = 80;

// Colours that nobody chose are those of the terrain.
const state = { terrain: null, times: 1, colours: null, shaded: true };
let terrains = [];
let source = null; // what tiles and heights come from
let map = null;
let generation = 0; // of the terrain that is shown
let styled = 0; // the generation whose style the map has

// State of the page: waiting, complete or failed.

function tell(condition, message = "") {
  document.body.dataset.state = condition;
  element("message").textContent = message;
  element("again").hidden = condition !== "failed";
  element("map").ariaBusy = String(condition === "waiting");
}

function wait() {
  if (document.body.dataset.state === "complete") tell("waiting", "Loading terrain …");
}

function check({ type }) {
  if (document.body.dataset.state === "failed" || styled !== generation) return;
  if (!map.areTilesLoaded()) wait();
  else if (type === "idle" || flying) tell("complete");
}

function fail({ error }) {
  if (error?.name === "AbortError") return;
  tell("failed", error?.status
    ? `Part of this terrain could not be loaded: the server answered ${error.status}.`
    : `Part of this terrain could not be loaded: ${error?.message ?? "no reason is known"}`);
}

// The map.

function boundsWithRim([west, south, east, north]) {
  const [wide, high] = [AROUND * (east - west), AROUND * (north - south)];
  const turns = west - wide < -180 || east + wide > 180; // bounds end there: go all the way round
  return [turns ? -180 : west - wide, Math.max(south - high, -85.0511),
    turns ? 180 : east + wide, Math.min(north + high, 85.0511)];
}

const relief = () => reliefOf(stopsOf(state.terrain, state.colours), state.terrain.encoding);
const visibility = () => (state.shaded ? "visible" : "none");

function styleOf({ terrain, times }) {
  const addresses = (kind, query) => source.tilesOf(terrain, kind, `rim=${RIM}${query}`);
  const tiles = { tileSize: 256, bounds: boundsWithRim(terrain.bounds), maxzoom: terrain.maxzoom };
  const { encoding } = terrain;
  // Voids are painted over; a map reads transparent pixels as the lowest height there is.
  const asked = `&encoding=${encoding}&voids=height`;
  const heights = () => ({
    type: "raster-dem", encoding, tiles: addresses("rgb", asked), ...tiles,
  });
  const paint = `&color=${GROUND.slice(1)}`;
  return {
    version: 8,
    // Two sources of the same tiles: shading wants its own, so that it keeps its sharpness.
    sources: {
      heights: heights(),
      shading: heights(),
      voids: { type: "raster", tiles: addresses("voids", paint), ...tiles },
    },
    sky: { "sky-color": "#8fb7dc", "horizon-color": "#dfe9f0", "fog-color": "#dfe9f0" },
    terrain: { source: "heights", exaggeration: times },
    layers: [
      { id: "ground", type: "background", paint: { "background-color": GROUND } },
      {
        id: "tints", type: "color-relief", source: "shading",
        paint: { "color-relief-color": relief() },
      },
      {
        id: "shading", type: "hillshade", source: "shading",
        layout: { visibility: visibility() },
        paint: { "hillshade-exaggeration": 0.55, "hillshade-shadow-color": "#20303c" },
      },
      { id: "voids", type: "raster", source: "voids", paint: { "raster-fade-duration": 0 } },
    ],
  };
}

function coloursOf({ terrain, colours }) {
  return colours ?? terrain.ramp;
}

/** Give the map what of `state` can change while a terrain is shown. */
function apply() {
  element("times").value = state.times;
  element("factor").value = state.times.toFixed(1);
  element("colours").value = coloursOf(state);
  element("shaded").checked = state.shaded;
  element("light").hidden = !state.shaded;
  showLegend();
  if (styled === generation) { // otherwise the style on its way gets it
    map.setTerrain({ source: "heights", exaggeration: state.times });
    map.setPaintProperty("tints", "color-relief-color", relief());
    map.setLayoutProperty("shading", "visibility", visibility());
  }
  keepPermalink();
}

function show(terrain, view) {
  generation += 1;
  state.terrain = terrain;
  askedHeight.abort();
  element("place").textContent = ASKING;
  element("terrain").value = terrain.name;
  document.title = `${terrain.name} – terrainwave`;
  describe(terrain);
  tell("waiting", "Loading terrain …");
  map.setStyle(styleOf(state), { diff: false });
  if (view) map.jumpTo(view);
  else home(terrain);
  apply();
  document.body.dispatchEvent(new CustomEvent("show", { detail: terrain }));
}

/** Take another terrain of the source, and show it. */
export function add(terrain) {
  terrains.push(terrain);
  element("terrain").append(new Option(terrain.name, terrain.name));
  element("terrain").hidden = false;
  show(terrain);
}

function home(terrain) {
  const { bounds, pitch, left, padding } = homeOf(terrain, element("map"), element("panel").open);
  map.setPadding({ left, top: 0, right: 0, bottom: 0 });
  map.fitBounds(bounds, { pitch, bearing: 0, animate: false, padding });
}

// The panel.

function describe(terrain) {
  element("about").replaceChildren(
    `${terrain.columns} × ${terrain.rows} samples in ${(terrain.bytes / 1e6).toFixed(2)} MB,`
    + ` ${terrain.bits_per_sample.toFixed(2)} bit each. Every height within `,
    made("strong", {}, `± ${withUnit(roundedUp(terrain.error, 3), terrain)}`),
    " of the original.",
  );
  list("tags", Object.entries(terrain.origin));
  element("origin").hidden = !Object.keys(terrain.origin).length;
  element("addresses").replaceChildren(
    copyable("This view", location.href),
    ...source.addressesOf(terrain).map(([label, address]) => copyable(label, address)),
  );
}

function showLegend() {
  const stops = state.terrain.ramps[coloursOf(state)];
  element("legend").hidden = !stops;
  if (!stops) return;
  const [low, high] = [stops[0][0], stops.at(-1)[0]];
  element("bar").style.background = gradientOf(stops);
  element("ticks").replaceChildren(...ticksOf(low, high).map((height) => {
    const style = `left: ${100 * (height - low) / (high - low)}%`;
    return made("span", { style }, withUnit(written(height, high - low), state.terrain));
  }));
}

// The address of this view.

let keeping = 0;

function keepPermalink() {
  clearTimeout(keeping);
  keeping = setTimeout(() => {
    host.keep({ ...state, colours: coloursOf(state) }, map);
    const field = element("addresses").querySelector("input");
    if (field) field.value = location.href;
  }, 200);
}

function followPermalink() {
  const { terrain: name, view, times, colours, shaded } = host.view();
  const isColours = colours !== undefined
    && [...element("colours").options].some(({ value }) => value === colours);
  if (times !== undefined) state.times = times;
  if (isColours) state.colours = colours;
  if (shaded !== undefined) state.shaded = shaded;
  const terrain = terrains.find((one) => one.name === name) ?? state.terrain ?? terrains[0];
  if (terrain !== state.terrain) {
    show(terrain, view);
  } else {
    if (view) map.jumpTo(view);
    apply();
  }
}

// The height under the cursor, at a touch, or in the middle when keys move the map.

let askedHeight = new AbortController();
let lastAsked = 0;
let laterHeight = 0;

function askHeightSoon(place) {
  clearTimeout(laterHeight);
  const left = lastAsked + MILLISECONDS_BETWEEN_HEIGHTS - performance.now();
  laterHeight = setTimeout(() => askHeight(place), Math.max(left, 0));
}

async function askHeight(lngLat, what = "") {
  const { lng, lat } = lngLat.wrap();
  const { terrain } = state;
  clearTimeout(laterHeight);
  askedHeight.abort();
  askedHeight = new AbortController();
  const { signal } = askedHeight;
  lastAsked = performance.now();
  let told = "no answer from the server";
  try {
    const answer = await source.heightAt(terrain, { lng, lat }, signal);
    if (answer) {
      const { height, max_error: error } = answer;
      told = height === null ? "no height here"
        : `${withUnit(height.toFixed(2), terrain)}`
          + ` (± ${withUnit(roundedUp(error, 3), terrain)})`;
    }
  } catch { /* said below, or aborted */ }
  if (signal.aborted) return;
  const where = terrain.where?.(lng, lat) ?? `${degrees(lat, "N", "S")}, ${degrees(lng, "E", "W")}`;
  element("place").textContent = `${what}${where}: ${told}`;
}

function degrees(angle, positive, negative) {
  return `${Math.abs(angle).toFixed(5)}° ${angle < 0 ? negative : positive}`;
}

// Flying round.

let flying = false;
let last = 0;

function turn(now) {
  if (!flying) return;
  map.setBearing(map.getBearing() + DEGREES_PER_SECOND * Math.min(now - last, 100) / 1000);
  last = now;
  requestAnimationFrame(turn);
}

function fly() {
  flying = !flying;
  element("fly").textContent = flying ? "Stop" : "Fly round";
  element("fly").ariaPressed = String(flying);
  last = performance.now();
  requestAnimationFrame(turn);
}

function connect() {
  map.on("style.load", () => {
    if (!generation) return; // the empty one
    styled = generation; // the map drops a style that another one replaces
    apply();
  });
  map.on("error", fail);
  for (const event of ["render", "idle", "sourcedataloading"]) map.on(event, check);
  map.on("moveend", ({ originalEvent }) => {
    keepPermalink();
    if (originalEvent?.type === "keydown") askHeight(map.getCenter(), "Middle: ");
  });
  map.on("mousemove", ({ lngLat }) => askHeightSoon(lngLat));
  map.on("click", ({ lngLat }) => askHeight(lngLat));
  element("fly").addEventListener("click", fly);
  element("home").addEventListener("click", () => home(state.terrain));
  element("again").addEventListener("click", () => show(state.terrain, {}));
  const choose = (id, event, chosen) => element(id).addEventListener(event, ({ target }) => {
    state[id] = chosen(target);
    apply();
  });
  choose("times", "input", ({ value }) => Number(value));
  choose("colours", "change", ({ value }) => value);
  choose("shaded", "change", ({ checked }) => checked);
  element("terrain").addEventListener("change", ({ target }) => {
    show(terrains.find(({ name }) => name === target.value));
  });
  host.follow(followPermalink);
}

async function start() {
  element("panel").open = !isNarrow;
  ({ terrains, source } = await host.listed({ addProtocol }));
  element("terrain").replaceChildren(...terrains.map(({ name }) => new Option(name, name)));
  element("terrain").hidden = terrains.length < 2;
  map = new Map({
    container: "map",
    style: { version: 8, sources: {}, layers: [] },
    maxPitch: 80,
    attributionControl: { customAttribution: "terrainwave", compact: isNarrow },
  });
  map.addControl(new NavigationControl({ visualizePitch: true }), "top-right");
  map.addControl(new ScaleControl(), "bottom-right");
  connect();
  host.begin?.(map);
  followPermalink();
  window.terrainMap = map; // for the curious and for tests; #map is a window property already
}

export { map, show, source, state, terrains };
export const started = start();
started.catch((error) => {
  tell("failed", `The terrain cannot be shown: ${error.message}`);
  element("again").onclick = () => location.reload();
});
