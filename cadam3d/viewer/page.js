/* Shows the snapshot of this page in its whole window. */
(() => {
  "use strict";
  const find = (id) => document.getElementById(id);
  const options = JSON.parse(find("view").dataset.options);
  const view = new SplatView(find("view"), {
    ...options,
    keyboard: window,
    label: `3D view of ${document.title}`,
  });
  view.controls(find("controls"));
  // Nothing but the text of the page is decoded, so that it also works from a file.
  const text = atob(find("snapshot").textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const isDone = () => find("loading").remove();
  view.load(bytes.buffer).then(isDone, isDone);
  globalThis.view = view; // for the console of the browser
})();
