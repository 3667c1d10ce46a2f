// Elements of the page, and lines and points on its map. Texts of files are untrusted: they become text, never HTML.

const NOTHING = { type: "FeatureCollection", features: [] };

export const element = (id) => document.getElementById(id);

/** Return a new element with properties and children, elements or texts. */
export function made(tag, properties, ...children) {
  const found = Object.assign(document.createElement(tag), properties);
  found.append(...children);
  return found;
}

/** Show [name, text], … in a list of descriptions. */
export function list(id, entries) {
  element(id).replaceChildren(...entries.flatMap(([name, text]) => [made("dt", {}, name), made("dd", {}, text)]));
}

/** Return a list item: what an address is for, the address in a field, a button that copies it. */
export function copyable(label, address) {
  const field = made("input", { type: "text", readOnly: true, value: address, ariaLabel: label });
  field.addEventListener("focus", () => field.select());
  const button = made("button", { type: "button", ariaLabel: `Copy the address: ${label}` }, "Copy");
  button.addEventListener("click", async () => {
    button.textContent = await copy(field) ? "Copied" : "Press Ctrl+C";
    setTimeout(() => { button.textContent = "Copy"; }, 2500);
  });
  return made("li", {}, label, made("div", { className: "line" }, field, button));
}

/** Copy a field's text and say whether that worked; otherwise the text is left selected. */
async function copy(field) {
  try {
    await navigator.clipboard.writeText(field.value);
    return true;
  } catch { // not there but on HTTPS and localhost, or not allowed
    field.select();
    return document.execCommand("copy");
  }
}

/** Return a feature of GeoJSON. */
export function featureOf(type, coordinates) {
  return { type: "Feature", properties: {}, geometry: { type, coordinates } };
}

/** Draw a feature, or none, as a layer { type, paint }. A new style drops it: then it is drawn again. */
export function drawOn(map, id, layer, feature) {
  if (!map.getStyle()?.sources.heights) return; // the empty style, or one on its way
  const source = map.getSource(id);
  if (source) {
    source.setData(feature ?? NOTHING);
  } else if (feature) {
    map.addSource(id, { type: "geojson", data: feature });
    map.addLayer({ id, source: id, ...layer });
  }
}
