// Addresses with a button that copies them.

/** Return a list item: what it is for, the address in a field, a button that copies it. */
export function copyable(label, address) {
  const field = document.createElement("input");
  Object.assign(field, { type: "text", readOnly: true, value: address });
  field.setAttribute("aria-label", label);
  field.addEventListener("focus", () => field.select());
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: "Copy" });
  button.setAttribute("aria-label", `Copy the address: ${label}`);
  button.addEventListener("click", async () => {
    button.textContent = await copy(field) ? "Copied" : "Press Ctrl+C";
    setTimeout(() => { button.textContent = "Copy"; }, 2500);
  });
  const line = document.createElement("div");
  line.className = "line";
  line.append(field, button);
  const item = document.createElement("li");
  item.append(label, line);
  return item;
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
