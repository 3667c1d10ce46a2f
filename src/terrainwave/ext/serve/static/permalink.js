// The page's state in location.hash: #terrain=alps&view=lat,lon,zoom,bearing,pitch&…

const VIEW = [[-90, 90], [-540, 540], [0, 24], [-360, 360], [0, 80]];

/** Return what a hash tells; whatever is not there, or no sense, is undefined. */
export function read(hash) {
  const told = new URLSearchParams(hash.replace(/^#/, ""));
  const view = (told.get("view") ?? "").split(",").map(numberOf);
  const isView = view.length === VIEW.length
    && view.every((number, i) => number >= VIEW[i][0] && number <= VIEW[i][1]);
  const times = numberOf(told.get("times"));
  return {
    terrain: told.get("terrain") ?? undefined,
    view: isView ? cameraOf(view) : undefined,
    times: times >= 0.5 && times <= 5 ? times : undefined,
    colours: told.get("colours") ?? undefined,
    shaded: told.has("shaded") ? told.get("shaded") !== "0" : undefined,
  };
}

/** Return the hash that `read` understands. */
export function write({ terrain, times, colours, shaded }, map) {
  const { lng, lat } = map.getCenter().wrap();
  const view = [
    lat.toFixed(6), lng.toFixed(6), map.getZoom().toFixed(3), map.getBearing().toFixed(1),
    map.getPitch().toFixed(1),
  ];
  const told = new URLSearchParams({
    terrain: terrain.name, view: view.join(","), times, colours, shaded: Number(shaded),
  });
  return `#${told.toString().replaceAll("%2C", ",")}`;
}

function cameraOf([lat, lng, zoom, bearing, pitch]) {
  return { center: [lng, lat], zoom, bearing, pitch };
}

function numberOf(text) {
  return text ? Number(text) : NaN;
}
