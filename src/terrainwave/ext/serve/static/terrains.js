// The list of terrains, which is asked for once, whoever needs it.

/** A promise of what terrains.json says; it fails where there is none. */
export const terrains = fetch("terrains.json").then((answer) => {
  if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
  return answer.json();
});
