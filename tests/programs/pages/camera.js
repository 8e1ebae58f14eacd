// What every page needs: the settings in its address, the camera, and a report of the result to the test.

const settings = new URLSearchParams(location.search);

export const file = settings.get("file");
export const option = (name) => settings.get(name);
export const size = Number(settings.get("size"));

// Return a camera of three.js at the place that the test chose, looking at the origin, with +y up.
export function makeCamera(THREE) {
  const camera = new THREE.PerspectiveCamera(Number(settings.get("fov")), 1, 0.01, 100);
  camera.position.set(...settings.get("eye").split(",").map(Number));
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  return camera;
}

// Draw with `draw`, and report "drawn" or the reason why not as window.result.
export async function report(draw) {
  const refuse = (reason) => (window.result ??= `refused: ${reason?.message ?? reason}`);
  window.addEventListener("error", (event) => refuse(event.message));
  window.addEventListener("unhandledrejection", (event) => refuse(event.reason));
  try {
    await draw();
    window.result ??= "drawn";
  } catch (error) {
    refuse(error);
  }
}

export const nextFrame = () => new Promise((resolve) => requestAnimationFrame(resolve));
