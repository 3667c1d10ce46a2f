// The page of `terrainwave serve`: MapLibre over the terrain-RGB tiles of one file at a time.
import { Map, NavigationControl, ScaleControl } from "./maplibre/maplibre-gl.mjs";

// Hypsometric tints, from the lowest to the highest height of the file.
const TINTS = [
  [0.0, "#3f6b4f"],
  [0.2, "#7f9a5c"],
  [0.42, "#cdbb84"],
  [0.65, "#a97c55"],
  [0.85, "#8d7a72"],
  [1.0, "#f4f4f2"],
];
const PITCH = 62;
const DEGREES_PER_SECOND = 6;

const element = (id) => document.getElementById(id);
const terrains = await (await fetch("terrains.json")).json();
for (const terrain of terrains) {
  element("terrain").append(new Option(terrain.name, terrain.name));
}
element("terrain").hidden = terrains.length < 2;

const map = new Map({
  container: "map",
  style: { version: 8, sources: {}, layers: [] },
  maxPitch: 80,
  attributionControl: { customAttribution: "terrainwave" },
});
map.addControl(new NavigationControl({ visualizePitch: true }), "top-right");
map.addControl(new ScaleControl(), "bottom-right");

let shown = terrains[0];

function tints({ lowest, highest }) {
  const range = Math.max(highest - lowest, 1);
  return ["interpolate", ["linear"], ["elevation"],
    lowest - 0.5, "rgba(0, 0, 0, 0)", // voids are 1 m below
    ...TINTS.flatMap(([share, color]) => [lowest + share * range, color])];
}

function styleOf(terrain) {
  const source = () => ({
    type: "raster-dem",
    url: new URL(`${terrain.name}/tiles.json`, document.baseURI).href,
    encoding: "mapbox",
    tileSize: 256,
  });
  return {
    version: 8,
    // Two sources of the same tiles: shading wants its own, so that it keeps its sharpness.
    sources: { heights: source(), shading: source() },
    sky: { "sky-color": "#8fb7dc", "horizon-color": "#dfe9f0", "fog-color": "#dfe9f0" },
    terrain: { source: "heights", exaggeration: Number(element("exaggeration").value) },
    layers: [
      { id: "ground", type: "background", paint: { "background-color": "#dbe4e8" } },
      {
        id: "tints", type: "color-relief", source: "shading",
        paint: { "color-relief-color": tints(terrain) },
      },
      {
        id: "shading", type: "hillshade", source: "shading",
        paint: { "hillshade-exaggeration": 0.55, "hillshade-shadow-color": "#20303c" },
      },
    ],
  };
}

function home(terrain) {
  const [west, south, east, north] = terrain.bounds;
  map.fitBounds([[west, Math.max(south, -85)], [east, Math.min(north, 85)]],
    { pitch: east - west > 90 ? 0 : PITCH, bearing: 0, animate: false, padding: 20 });
}

function describe(terrain) {
  const error = terrain.error.toPrecision(3).replace(/\.?0+$/, "");
  const strong = document.createElement("strong");
  strong.textContent = `± ${error} m`;
  element("about").replaceChildren(
    `${terrain.columns} × ${terrain.rows} samples in ${(terrain.bytes / 1e6).toFixed(2)} MB,`
    + ` ${terrain.bits_per_sample.toFixed(2)} bit each. Every height within `,
    strong,
    " of the original.",
  );
}

function show(terrain) {
  shown = terrain;
  describe(terrain);
  map.setStyle(styleOf(terrain), { diff: false });
  home(terrain);
}

let flying = false;
let last = 0;

function turn(now) {
  if (!flying) return;
  map.setBearing(map.getBearing() + DEGREES_PER_SECOND * Math.min(now - last, 100) / 1000);
  last = now;
  requestAnimationFrame(turn);
}

element("fly").addEventListener("click", () => {
  flying = !flying;
  element("fly").textContent = flying ? "Stop" : "Fly round";
  last = performance.now();
  requestAnimationFrame(turn);
});
element("home").addEventListener("click", () => home(shown));
element("exaggeration").addEventListener("input", ({ target }) => {
  element("factor").value = Number(target.value).toFixed(1);
  map.setTerrain({ source: "heights", exaggeration: Number(target.value) });
});
element("terrain").addEventListener("change", ({ target }) => {
  show(terrains.find(({ name }) => name === target.value));
});
map.on("click", async ({ lngLat }) => {
  const { lng, lat } = lngLat.wrap();
  const answer = await fetch(`${shown.name}/height?lon=${lng}&lat=${lat}`);
  const { height, max_error: error } = await answer.json();
  element("place").textContent = height === null
    ? `${lng.toFixed(5)}, ${lat.toFixed(5)}: no height`
    : `${lng.toFixed(5)}, ${lat.toFixed(5)}: ${height.toFixed(2)} m (± ${error.toPrecision(3)} m)`;
});

show(shown);
window.terrainMap = map; // for the curious and for tests; #map is a window property already
