// Tiles and heights from `terrainwave serve`.

const at = (terrain, path) => new URL(`${terrain.name}${path}`, document.baseURI).href;

/** Return the addresses of a terrain's tiles, "rgb" or "voids", of this version of it, for a style. */
function tilesOf(terrain, kind, query) {
  const address = at(terrain, `/${kind}/{z}/{x}/{y}.png?v=${terrain.tag}&${query}`);
  return [address.replaceAll("%7B", "{").replaceAll("%7D", "}")];
}

/** Return { height, max_error } at a place, or null if the server does not know. */
async function heightAt(terrain, { lng, lat }, signal) {
  const answer = await fetch(at(terrain, `/height?lon=${lng}&lat=${lat}`), { signal });
  return answer.ok ? answer.json() : null;
}

/** Return [what it is for, address] of all that can be had of a terrain. */
function addressesOf(terrain) {
  return [
    ["Tiles, TileJSON: MapLibre", at(terrain, "/tiles.json")],
    ["Tiles, XYZ: terrain-RGB", `${at(terrain, "/rgb/")}{z}/{x}/{y}.png`],
    ["Tiles, quantized mesh: CesiumJS", at(terrain, "/mesh")],
    ["GeoTIFF: QGIS, GDAL after /vsicurl/", at(terrain, ".tif")],
    ["The file: terrainwave.open", at(terrain, ".twz")],
  ];
}

export const open = () => ({ tilesOf, heightAt, addressesOf });
