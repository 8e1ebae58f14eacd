/* Shows the snapshot of this page in its whole window. */
(() => {
  "use strict";
  const find = (id) => document.getElementById(id);
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  const options = JSON.parse(find("view").dataset.options);
  const view = new SplatView(find("view"), {
    background: options.background ?? (isDark ? [0.07, 0.075, 0.085] : [1, 1, 1]),
    camera: options.camera,
    keyboard: window,
    label: `3D view of ${document.title}`,
  });
  view.controls(find("controls"));
  // Nothing but the text of the page is decoded, so that it also works from a file.
  const text = find("snapshot").textContent;
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const isDone = () => find("loading").remove();
  view.load(bytes.buffer).then(isDone, isDone);
  globalThis.view = view;
})();
