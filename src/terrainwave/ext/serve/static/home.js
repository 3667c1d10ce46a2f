// The view of all of a terrain: the map's, and that of the still before there is a map.

const PITCH = 62;
// Of the width: what is left free on both sides, as the near edge is wider than the middle.
const SPREAD = 0.12;
const BESIDE_PANEL = 260;

export const isNarrow = window.matchMedia("(max-width: 600px)").matches;

/** Return what `fitBounds` takes, and the pixels `left` that the panel covers. */
export function homeOf({ bounds: [west, south, east, north] }, { clientWidth }, isOpen) {
  const left = isNarrow || !isOpen ? 0 : BESIDE_PANEL;
  const free = SPREAD * (clientWidth - left);
  return {
    bounds: [[west, Math.max(south, -85)], [east, Math.min(north, 85)]],
    pitch: east - west > 90 ? 0 : PITCH,
    left,
    padding: { left: free, right: free, top: 50, bottom: 50 },
  };
}
