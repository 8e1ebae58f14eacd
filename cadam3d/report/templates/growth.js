/* Shows the snapshots of this page in its 3D view, with a slider over the steps of the training. */
(() => {
  "use strict";
  const find = (id) => document.getElementById(id);
  const frames = [...document.querySelectorAll("script.snapshot")];
  const place = find("view");
  const view = new SplatView(place, { embedded: true, label: place.dataset.label });
  view.controls(find("controls"));
  const decode = (frame) => Uint8Array.from(atob(frame.textContent), (character) => character.charCodeAt(0)).buffer;
  const slider = find("step");
  let playing = null; // the timer of the next step

  let isBusy = false;
  let wanted = frames.length - 1;
  /* Load the wanted snapshot. If the slider has moved on before its turn, it is skipped. */
  async function show(index) {
    wanted = index;
    if (slider) {
      slider.value = index;
      find("shown").textContent = `step ${frames[index].dataset.step}`;
      slider.setAttribute("aria-valuetext", find("shown").textContent);
    }
    if (isBusy) return;
    isBusy = true;
    for (let current = -1; current !== wanted;) {
      current = wanted;
      await view.load(decode(frames[current])).catch(() => {});
    }
    isBusy = false;
  }

  function stop() {
    clearInterval(playing);
    playing = null;
    find("play").textContent = "Play";
  }

  show(wanted);
  if (slider) {
    slider.addEventListener("input", () => { stop(); show(slider.valueAsNumber); });
    find("play").addEventListener("click", () => {
      if (playing !== null) { stop(); return; }
      find("play").textContent = "Pause";
      let next = wanted === frames.length - 1 ? 0 : wanted + 1;
      show(next);
      playing = setInterval(() => {
        if (next === frames.length - 1) { stop(); return; }
        show(++next);
      }, 600);
    });
  }
  globalThis.view = view;
})();
