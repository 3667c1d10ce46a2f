// A still of the first view, shown until MapLibre's is complete: the terrain from above, tilted as the
// map's camera sees the ground. Of heights it shows colours and shade only.
import { stopsOf } from "./colours.js";
import { homeOf, isNarrow } from "./home.js";

const PIXELS = 256; // along the longer side
const N_COLOURS = 1024;
// Drawn by the processor: a graphics card, or what stands for one, is busy with the map.
const BY_PROCESSOR = { willReadFrequently: true };
const WORLD = 512; // pixels of the map's world at zoom 0
const DISTANCE = 1.5; // of the map's camera, in heights of the window
const LIGHT = 0.55; // most shade of a slope that faces away from the light at the upper left
const [STEEP_BELOW, STEEPER] = [15, 0.3]; // as the map: slopes in shade double with 1 / 0.3 zooms below 15

const xOf = (lon) => (lon + 180) / 360;
const yOf = (lat) => (1 - Math.asinh(Math.tan((lat * Math.PI) / 180)) / Math.PI) / 2;

/** Return the place that the map's camera looks at, 0 to 1 in the world, and the world's size in pixels. */
function cameraOf(terrain, view, place) {
  if (view) {
    const [lon, lat] = view.center;
    return { ...view, x: xOf(lon), y: yOf(lat), world: WORLD * 2 ** view.zoom, left: 0 };
  }
  const { bounds: [[west, south], [east, north]], pitch, left, padding } = homeOf(terrain, place, !isNarrow);
  const [across, down] = [xOf(east) - xOf(west), yOf(south) - yOf(north)];
  const { clientWidth, clientHeight } = place;
  const fitting = Math.min(
    (clientWidth - left - padding.left - padding.right) / across,
    (clientHeight - padding.top - padding.bottom) / down,
  );
  const world = Math.max(fitting, clientHeight); // a map shows nothing beyond the poles
  const beyond = clientHeight / 2 / world;
  const y = Math.min(Math.max(yOf(north) + down / 2, beyond), 1 - beyond);
  return { x: xOf(west) + across / 2, y, world, left, pitch, bearing: 0 };
}

/** Return the colours of heights from the first stop's to the last one's, RGBA. */
function coloursOf(stops) {
  const paint = new OffscreenCanvas(N_COLOURS, 1).getContext("2d", BY_PROCESSOR);
  const [low, high] = [stops[0][0], stops.at(-1)[0]];
  paint.fillStyle = paint.createLinearGradient(0, 0, N_COLOURS, 0);
  for (const [height, colour] of stops) paint.fillStyle.addColorStop((height - low) / (high - low), colour);
  paint.fillRect(0, 0, N_COLOURS, 1);
  return paint.getImageData(0, 0, N_COLOURS, 1).data;
}

/** Paint heights from above; `steepness`: of slopes in shade, times their own. */
function paint(canvas, { heights, spacing }, stops, steepness) {
  const { width, height } = canvas;
  const [colours, low, high] = [coloursOf(stops), stops[0][0], stops.at(-1)[0]];
  const picture = new ImageData(width, height);
  heights.forEach((here, i) => {
    if (Number.isNaN(here)) return;
    const at = Math.round((N_COLOURS - 1) * Math.min(Math.max((here - low) / (high - low), 0), 1));
    const east = (i + 1) % width ? heights[i + 1] - here : 0;
    // 0 on the last row, and beside voids.
    const slope = (steepness * (east + heights[i + width] - here)) / spacing || 0;
    const light = (LIGHT * slope) / Math.hypot(1, slope);
    for (let k = 0; k < 3; k++) {
      const colour = colours[4 * at + k];
      picture.data[4 * i + k] = colour + light * (light > 0 ? 255 - colour : colour);
    }
    picture.data[4 * i + 3] = 255;
  });
  canvas.getContext("2d", BY_PROCESSOR).putImageData(picture, 0, 0);
}

const isOver = () => document.body.dataset.state !== "waiting";

/** Show a still of the terrain, as `described` in terrains.json, in the view that `permalink.read` told. */
export async function showStill(maker, terrain, { view, colours, shaded = true }) {
  const { described } = terrain;
  const place = document.getElementById("map");
  const { clientWidth, clientHeight } = place;
  const { x, y, world, left, pitch, bearing } = cameraOf(described, view, place);
  const [west, south, east, north] = described.bounds;
  const [x0, y0, x1, y1] = [xOf(west), yOf(Math.min(north, 85)), xOf(east), yOf(Math.max(south, -85))];
  const canvas = document.createElement("canvas");
  const scale = PIXELS / Math.max(x1 - x0, y1 - y0);
  canvas.width = Math.max(Math.round(scale * (x1 - x0)), 1);
  canvas.height = Math.max(Math.round(scale * (y1 - y0)), 1);
  const plan = await maker.ask(terrain, "plan", [[x0, y0, x1, y1], canvas.width, canvas.height]);
  if (isOver()) return;
  const steepness = shaded ? 2 ** (STEEPER * Math.max(STEEP_BELOW - Math.log2(world / WORLD), 0)) : 0;
  paint(canvas, plan, stopsOf(described, colours), steepness);
  const still = document.createElement("div");
  still.id = "still";
  const middle = [left + (clientWidth - left) / 2, clientHeight / 2];
  still.style.perspective = `${DISTANCE * clientHeight}px`;
  still.style.perspectiveOrigin = `${middle[0]}px ${middle[1]}px`;
  Object.assign(canvas.style, {
    left: `${middle[0]}px`, top: `${middle[1]}px`,
    width: `${(x1 - x0) * world}px`, height: `${(y1 - y0) * world}px`,
    transform: `rotateX(${pitch}deg) rotateZ(${-bearing}deg)`
      + ` translate(${(x0 - x) * world}px, ${(y0 - y) * world}px)`,
  });
  still.append(canvas);
  place.after(still);
  const remove = () => still.remove();
  for (const event of ["pointerdown", "wheel", "keydown", "resize", "hashchange"]) {
    window.addEventListener(event, remove, { once: true });
  }
  new MutationObserver(() => isOver() && remove())
    .observe(document.body, { attributeFilter: ["data-state"] });
}
