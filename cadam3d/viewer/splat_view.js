/* SplatView: draws snapshots of 3D Gaussians (see pack.py) into an element of a page, with WebGL2 and nothing else.
 *
 *   const view = new SplatView(element, {background: [1, 1, 1], camera: {azimuth: 30}, keyboard: true});
 *   await view.load(arrayBuffer);
 *   view.show("depth");
 *
 * The pictures equal the ones that cadam3d's rasterizers draw: EWA splatting with a blur of 0.3 pixels^2, contributions below
 * 1/255 skipped and above 0.99 capped, and colours that are blended as they are. Angles are in degrees and lengths in
 * world units: +z is up, and azimuth 0 looks at the front of the object, which faces +x.
 */
globalThis.SplatView = (() => {
  "use strict";

  const MAGIC = "CADAM3DV";
  const VERSION = 1;
  const HEADER = 64; // bytes
  const RECORD = 32; // bytes per Gaussian
  const LAYERS_LIMIT = 64;
  const BUILT_IN = ["rgb", "depth", "opacity"];
  const NEAR = 0.01; // times the radius of the object, but at most world units: as near as the rasterizers draw
  const FAR = 1e15; // world units
  const PIXELS_LIMIT = 4e6; // pixels of the picture, so that large screens of high density stay fluid
  const DENSITY_LIMIT = 2; // device pixels per CSS pixel
  const SLOW = 45; // milliseconds per frame above which moving pictures become coarser
  const COARSEST = 4; // times as coarse along each side
  const HOME = { azimuth: 30, elevation: 15, fov: 40 }; // degrees
  const DEGREE = Math.PI / 180;
  // Gaussians per instance. An instance of a single quad would leave most of a graphics card idle.
  const BATCH = 128;
  // The colours of layers, from the low to the high end, and of Gaussians without a value.
  const GRADIENT = [[0.21, 0.12, 0.43], [0.19, 0.37, 0.66], [0.11, 0.6, 0.62], [0.42, 0.79, 0.42], [0.99, 0.91, 0.34]];
  const [WHITE, GREY, DARK] = [[1, 1, 1], [0.5, 0.5, 0.5], [0.07, 0.075, 0.085]];
  const BACKGROUNDS = [["White", WHITE], ["Grey", GREY], ["Dark", DARK]];
  const NO_VALUE = [0.55, 0.55, 0.55];

  class SplatError extends Error {}

  /* Return {count, degree, low, high, focus, radius, layers, records, rest} of a snapshot; throw if it is not one. */
  function parse(buffer) {
    const fail = (reason) => { throw new SplatError(`This is not a snapshot that can be drawn: ${reason}.`); };
    if (!(buffer instanceof ArrayBuffer) || buffer.byteLength < HEADER) fail("it is too short");
    const view = new DataView(buffer);
    const magic = String.fromCharCode(...new Uint8Array(buffer, 0, 8));
    if (magic !== MAGIC) fail("it begins with other bytes");
    const [version, count, degree, layerCount] = [8, 12, 16, 20].map((offset) => view.getUint32(offset, true));
    if (version !== VERSION) fail(`its format has version ${version}, and this page reads version ${VERSION}`);
    if (degree > 3) fail(`its SH degree is ${degree}`);
    if (layerCount > LAYERS_LIMIT) fail(`it has ${layerCount} layers`);
    const floats = Array.from({ length: 10 }, (_, i) => view.getFloat32(24 + 4 * i, true));
    if (!floats.every(Number.isFinite) || !(floats[9] > 0)) fail("its bounds are not finite");
    const pad = (length) => Math.ceil(length / 16) * 16;
    const layers = [];
    let offset = HEADER;
    for (let i = 0; i < layerCount; i++) {
      if (offset + 16 > buffer.byteLength) fail("it ends in the names of its layers");
      const length = view.getUint32(offset + 12, true);
      if (length > buffer.byteLength - offset - 16) fail("it ends in the names of its layers");
      const name = new TextDecoder().decode(new Uint8Array(buffer, offset + 16, length));
      const [low, high] = [view.getFloat32(offset, true), view.getFloat32(offset + 4, true)];
      if (!Number.isFinite(low) || !Number.isFinite(high)) fail("the range of a layer is not finite");
      layers.push({ name, low, high, isLog: view.getUint32(offset + 8, true) === 1 });
      offset += 16 + Math.ceil(length / 4) * 4;
    }
    offset = pad(offset);
    const expected = offset + count * (RECORD + 16 * degree) + layerCount * pad(count);
    if (buffer.byteLength !== expected) fail(`it has ${buffer.byteLength} bytes instead of ${expected}`);
    const records = new Uint32Array(buffer, offset, count * 8);
    offset += count * RECORD;
    const rest = new Uint32Array(buffer, offset, count * 4 * degree);
    offset += count * 16 * degree;
    for (const layer of layers) {
      layer.levels = new Uint8Array(buffer, offset, count);
      offset += pad(count);
    }
    const [low, high, focus, radius] = [floats.slice(0, 3), floats.slice(3, 6), floats.slice(6, 9), floats[9]];
    return { count, degree, low, high, focus, radius, layers, records, rest };
  }

  /* Return an object that sorts points by their depth. Its text is also the program of the worker, so it refers to
   * nothing outside of itself. Two passes over 16 bits each sort the bits of float32 exactly. Equal depths keep the
   * order of rows. */
  function makeSorter() {
    const starts = [new Uint32Array(65536), new Uint32Array(65536)];
    let points = new Float32Array(0); // x, y, z of each
    let depths = new Float32Array(0);
    let keys = new Uint32Array(0); // the bits of the depths, in the order of unsigned numbers
    let half = new Uint32Array(0); // rows in the order of the lower 16 bits
    return {
      load(next) {
        points = next;
        depths = new Float32Array(points.length / 3);
        keys = new Uint32Array(depths.buffer);
        half = new Uint32Array(depths.length);
      },
      /* Write the rows into an array, the farthest first, and return it. */
      sort([x, y, z], spare) {
        const count = depths.length;
        const order = spare && spare.length === count ? spare : new Uint32Array(count);
        const [low, high] = starts;
        low.fill(0);
        high.fill(0);
        for (let i = 0; i < count; i++) {
          depths[i] = x * points[3 * i] + y * points[3 * i + 1] + z * points[3 * i + 2];
          const bits = keys[i];
          const key = (bits & 0x80000000 ? ~bits : bits | 0x80000000) >>> 0;
          keys[i] = key;
          low[key & 0xffff]++;
          high[key >>> 16]++;
        }
        for (let i = 0, before = 0, above = 0; i < 65536; i++) {
          const [here, there] = [low[i], high[i]];
          low[i] = before;
          high[i] = above;
          before += here;
          above += there;
        }
        for (let i = 0; i < count; i++) half[low[keys[i] & 0xffff]++] = i;
        for (let i = 0; i < count; i++) order[count - 1 - high[keys[half[i]] >>> 16]++] = half[i];
        return order;
      },
    };
  }

  /* Sorts in a worker, or in this thread where a browser refuses workers. Calls done(generation, order). */
  class Sorting {
    constructor(done) {
      this.done = done;
      this.points = null;
      this.last = null; // the request in progress
      this.local = null;
      const program = `"use strict"; const sorter = (${makeSorter})();
        onmessage = ({data}) => {
          if (data.points) { sorter.load(data.points); return; }
          const order = sorter.sort(data.axis, data.spare);
          postMessage({generation: data.generation, order}, [order.buffer]);
        };`;
      try {
        this.url = URL.createObjectURL(new Blob([program], { type: "text/javascript" }));
        this.worker = new Worker(this.url);
        this.worker.onerror = (event) => { event.preventDefault(); this.sortInThisThread(); };
        this.worker.onmessage = ({ data }) => this.finish(data.generation, data.order);
      } catch {
        this.sortInThisThread();
      }
    }

    sortInThisThread() {
      this.worker?.terminate();
      this.worker = null;
      this.local = makeSorter();
      if (this.points) this.local.load(this.points);
      if (this.last) this.request(this.last.generation, this.last.axis);
    }

    load(points) {
      this.points = points;
      if (this.worker) this.worker.postMessage({ points });
      else this.local.load(points);
    }

    request(generation, axis, spare) {
      this.last = { generation, axis };
      if (this.worker) {
        this.worker.postMessage({ generation, axis, spare }, spare ? [spare.buffer] : []);
      } else {
        const order = this.local.sort(axis, spare);
        queueMicrotask(() => this.finish(generation, order));
      }
    }

    finish(generation, order) {
      this.last = null;
      this.done(generation, order);
    }

    close() {
      this.done = () => {};
      this.worker?.terminate();
      if (this.url) URL.revokeObjectURL(this.url);
    }
  }

  // The basis functions of degree 1 to 3, in the order of 3DGS files, and lines that add them to a sum.
  const BASIS = [
    "-0.4886025119029199 * y", "0.4886025119029199 * z", "-0.4886025119029199 * x",
    "1.0925484305920792 * x * y", "-1.0925484305920792 * y * z", "0.31539156525252005 * (2. * zz - xx - yy)",
    "-1.0925484305920792 * x * z", "0.5462742152960396 * (xx - yy)",
    "-0.5900435899266435 * y * (3. * xx - yy)", "2.890611442640554 * x * y * z",
    "-0.4570457994644658 * y * (4. * zz - xx - yy)", "0.3731763325901154 * z * (2. * zz - 3. * xx - 3. * yy)",
    "-0.4570457994644658 * x * (4. * zz - xx - yy)", "1.445305721320277 * z * (xx - yy)",
    "-0.5900435899266435 * x * (xx - 3. * yy)",
  ];
  const byte = (j) => `whole(int(${["four", "more", "most"][j >> 4]}.${"xyzw"[(j >> 2) % 4]}), ${j % 4})`;
  const terms = (first, end) => BASIS.slice(first, end).map((basis, i) => {
    const j = 3 * (first + i);
    return `sum += ${basis} * vec3(${byte(j)}, ${byte(j + 1)}, ${byte(j + 2)});`;
  }).join("\n      ");

  const VERTEX = `#version 300 es
    precision highp float;
    precision highp int;
    precision highp usampler2D;
    uniform usampler2D records, rest, levels, order;
    uniform int count, degree, mode, width;
    uniform mat3 rotation;
    uniform vec3 eye;
    uniform vec2 size, range;
    uniform float focal, near;
    uniform vec3 gradient[${GRADIENT.length}];
    out vec2 offset;
    flat out vec4 paint;

    uvec4 texel(usampler2D data, int index) { return texelFetch(data, ivec2(index % width, index / width), 0); }

    float whole(int value, int place) { return float((value << (24 - 8 * place)) >> 24); }

    vec3 ramp(float share) {
      float place = clamp(share, 0., 1.) * ${(GRADIENT.length - 1).toFixed(1)};
      int first = min(int(place), ${GRADIENT.length - 2});
      return mix(gradient[first], gradient[first + 1], place - float(first));
    }

    // The axes of a Gaussian in the world, from the three stored components of its quaternion w, x, y, z.
    mat3 axes(uint ab, uint c) {
      vec3 three = (vec3(ab & 0x7fffu, (ab >> 16) & 0x7fffu, c) - 16383.) / (16383. * 1.41421356);
      float last = sqrt(max(1. - dot(three, three), 0.));
      uint place = ((ab >> 15) & 1u) + ((ab >> 31) << 1);
      vec4 q = place == 0u ? vec4(last, three)
        : place == 1u ? vec4(three.x, last, three.yz)
        : place == 2u ? vec4(three.xy, last, three.z)
        : vec4(three, last);
      q = normalize(q);
      float w = q.x, x = q.y, y = q.z, z = q.w;
      return mat3(
        1. - 2. * (y * y + z * z), 2. * (x * y + w * z), 2. * (x * z - w * y),
        2. * (x * y - w * z), 1. - 2. * (x * x + z * z), 2. * (y * z + w * x),
        2. * (x * z + w * y), 2. * (y * z - w * x), 1. - 2. * (x * x + y * y));
    }

    // What the coefficients of degree 1 and above add along a direction from the camera.
    vec3 harmonics(int index, vec3 d) {
      float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
      vec3 sum = vec3(0);
      uvec4 four = texel(rest, index * degree), last = four;
      uvec4 more = degree > 1 ? (last = texel(rest, index * degree + 1)) : four;
      uvec4 most = degree > 2 ? (last = texel(rest, index * degree + 2)) : four;
      ${terms(0, 3)}
      if (degree > 1) { ${terms(3, 8)} }
      if (degree > 2) { ${terms(8, 15)} }
      return sum * unpackHalf2x16(last.w).y / 127.;
    }

    void main() {
      gl_Position = vec4(0, 0, 2, 1);  // outside of the picture, unless the Gaussian is visible
      int place = gl_InstanceID * ${BATCH} + gl_VertexID / 4;
      if (place >= count) return;
      int index = int(texel(order, place).x);
      uvec4 first = texel(records, 2 * index), second = texel(records, 2 * index + 1);
      vec3 mean = uintBitsToFloat(first.xyz), away = mean - eye;
      float opacity = float(second.y >> 16) / 65535.;
      vec3 p = rotation * away;
      if (!(p.z > near && p.z < ${FAR.toExponential()} && opacity > 1. / 255.)) return;

      vec3 scales = exp(vec3(second.x & 0xffffu, second.x >> 16, second.y & 0xffffu) * (32. / 65535.) - 16.);
      mat3 turn = axes(first.w, second.w >> 16);
      // Rows of the camera's rotation are columns of its transpose.
      mat3 camera = transpose(rotation);
      // Outside of the picture the projection is linearised at most 0.15 of its size beyond the border.
      vec2 limit = 0.65 * size / focal, slope = clamp(p.xy / p.z, -limit, limit);
      vec3 alongX = focal / p.z * ((camera[0] - slope.x * camera[2]) * turn) * scales;
      vec3 alongY = focal / p.z * ((camera[1] - slope.y * camera[2]) * turn) * scales;
      float squareX = dot(alongX, alongX), squareY = dot(alongY, alongY);
      float varianceX = squareX + 0.3, covariance = dot(alongX, alongY);
      vec3 normal = cross(alongX, alongY);
      float determinant = dot(normal, normal) + 0.3 * (squareX + squareY) + 0.09;
      if (!(determinant < 1e30)) return;

      // The corners of a square around the circle of 1/255 in standard deviations, and their places in pixels.
      vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2. - 1.;
      offset = corner * sqrt(2. * log(255. * opacity));
      vec2 shift = vec2(sqrt(varianceX) * offset.x,
        covariance / sqrt(varianceX) * offset.x + sqrt(determinant / varianceX) * offset.y);
      vec2 pixel = focal * p.xy / p.z + shift;
      gl_Position = vec4(2. * pixel.x / size.x, -2. * pixel.y / size.y, 0, 1);

      vec3 color;
      if (mode == 0) {
        vec2 redGreen = unpackHalf2x16(second.z);
        color = vec3(redGreen, unpackHalf2x16(second.w).x);
        if (degree > 0) color += harmonics(index, normalize(away));
        color = min(max(color, 0.), 1000.);
      } else if (mode == 1) {
        color = ramp((p.z - range.x) / (range.y - range.x));
      } else if (mode == 2) {
        color = ramp(opacity);
      } else {
        uint level = texel(levels, index).x;
        color = level == 0u ? vec3(${NO_VALUE.join(", ")}) : ramp(float(level - 1u) / 254.);
      }
      paint = vec4(color, opacity);
    }`;

  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec2 offset;
    flat in vec4 paint;
    out vec4 result;
    void main() {
      float alpha = paint.a * exp(-0.5 * dot(offset, offset));
      if (alpha < 1. / 255.) discard;
      alpha = min(alpha, 0.99);
      result = vec4(paint.rgb * alpha, alpha);
    }`;

  // The last pass puts the picture in front of the background.
  const SCREEN_VERTEX = `#version 300 es
    void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0, 1); }`;

  const SCREEN_FRAGMENT = `#version 300 es
    precision highp float;
    uniform highp sampler2D picture;
    uniform vec2 scale;
    uniform vec3 background;
    out vec4 result;
    void main() {
      vec4 color = texture(picture, gl_FragCoord.xy * scale);
      result = vec4(color.rgb + (1. - color.a) * background, 1);
    }`;

  const RECORD_UNIT = 0, REST_UNIT = 1, LEVEL_UNIT = 2, ORDER_UNIT = 3, PICTURE_UNIT = 4;

  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  /* Return position and rows (right, down, forward) of a camera, as cadam3d.core.cameras.orbit computes them. */
  function pose({ azimuth, elevation, distance, target }) {
    const [a, e] = [azimuth * DEGREE, elevation * DEGREE];
    const outward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    const forward = outward.map((value) => -value);
    const right = cross(forward, up);
    return { eye: target.map((value, i) => value + distance * outward[i]), right, down: cross(forward, right), forward };
  }

  /* Return a number in few characters, for a legend. */
  function short(value) {
    const size = Math.abs(value);
    if (value === 0) return "0";
    return size >= 1e5 || size < 1e-3 ? value.toExponential(1).replace("e+", "e") : String(Number(value.toPrecision(3)));
  }

  function compile(gl, vertex, fragment) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const reasons = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new SplatError(`The graphics driver refuses a shader. ${reasons.join(" ")} ${gl.getProgramInfoLog(program)}`);
    }
    const uniforms = {};
    for (let i = 0; i < (gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  class SplatView {
    static parse = parse;
    static makeSorter = makeSorter;
    /* The colours of layers as a CSS gradient, for legends. */
    static gradient = `linear-gradient(90deg, ${GRADIENT.map(
      (color) => `rgb(${color.map((value) => Math.round(255 * value)).join(" ")})`).join(", ")})`;

    #element; #canvas; #gl = null; #options;
    #splats; #screen; #order; #orderRows = 0; #picture; #frame; #pictureSize = [0, 0]; #isHalf = false;
    #sorting = null; #isSorting = false; #sortedAlong = null; #generation = 0;
    #shown = null; #next = null; #spare = null; #layer = "rgb"; #levels = null;
    #camera; #home; #background; #rotating = false; #isPlaced = false;
    #request = 0; #lastTime = 0; #coarseness = 1; #isMoving = false; #restTimer = 0; #interval = 16; #wasMoving = false;
    #abort = new AbortController(); #observer = null; #message = null; #pointers = new Map();
    #refreshers = []; // of the controls
    onchange = null;
    onframe = null;

    /* Options, all of which may be left out:
     * background: RGB in [0, 1], else white, or dark for readers who prefer dark pages;
     * camera: some of {azimuth, elevation, distance, fov, target};
     * keyboard: true (while the canvas has the focus), false, or an element or window whose keys are used;
     * embedded: true in a page that scrolls. Then the wheel zooms only with Ctrl or after a click, and a finger that
     * moves up or down scrolls the page; rotate: true to begin with slow rotation, unless the user prefers less motion;
     * label: what the canvas shows, for screen readers. */
    constructor(element, options = {}) {
      this.#element = element;
      this.#options = { keyboard: true, embedded: false, label: "3D view", ...options };
      this.#background = options.background ?? (matchMedia("(prefers-color-scheme: dark)").matches ? DARK : WHITE);
      this.#home = { ...HOME, distance: 3, target: [0, 0, 0] };
      this.#camera = { ...this.#home };
      const canvas = document.createElement("canvas");
      this.#canvas = canvas;
      Object.assign(canvas.style, { display: "block", width: "100%", height: "100%", outlineOffset: "-2px",
        touchAction: this.#options.embedded ? "pan-y" : "none", cursor: "grab", userSelect: "none" });
      canvas.tabIndex = 0;
      canvas.setAttribute("role", "application");
      canvas.setAttribute("aria-label", `${this.#options.label}. Arrow keys turn it, plus and minus zoom.`);
      element.append(canvas);
      this.camera = options.camera ?? {};
      this.#gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, stencil: false,
        powerPreference: "high-performance" });
      if (!this.#gl) {
        this.#showMessage("This browser does not offer WebGL2, which the 3D view needs. A current version of Chrome, Edge, "
          + "Firefox or Safari shows it, with hardware acceleration switched on in the settings.");
        return;
      }
      try {
        this.#build();
      } catch (error) {
        this.#showMessage(error.message);
        this.#gl = null;
        return;
      }
      this.#sorting = new Sorting((generation, order) => this.#sorted(generation, order));
      this.#listen();
      this.#observer = new ResizeObserver(() => this.#draw());
      this.#observer.observe(canvas);
      this.rotating = Boolean(options.rotate) && !matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.#draw();
    }

    /* ---- what a page uses ---- */

    /* Draw other Gaussians and keep the camera. The promise resolves when they are drawn for the first time. */
    load(buffer) {
      if (!this.#gl) return Promise.reject(new SplatError(this.#message?.textContent ?? "The view is closed."));
      let data;
      try {
        data = parse(buffer);
        const limit = this.#textureWidth() * this.#gl.getParameter(this.#gl.MAX_TEXTURE_SIZE);
        if (data.count * Math.max(2, data.degree) > limit) {
          throw new SplatError(`This graphics driver draws at most ${Math.floor(limit / Math.max(2, data.degree))
            .toLocaleString("en")} of these Gaussians, and there are ${data.count.toLocaleString("en")}.`);
        }
      } catch (error) {
        this.#showMessage(error.message);
        return Promise.reject(error);
      }
      data.generation = ++this.#generation;
      // This snapshot replaces one that is not drawn yet. The promises of both resolve when this one is drawn.
      data.waiting = this.#next ? this.#next.waiting : [];
      if (this.#next) this.#release(this.#next);
      this.#next = data;
      this.#upload(data);
      this.#sorting.load(positions(data));
      this.#sort();
      return new Promise((resolve) => data.waiting.push(resolve));
    }

    get layers() {
      return [...BUILT_IN, ...(this.#latest?.layers ?? []).map((layer) => layer.name)];
    }

    get layer() {
      return this.#layer;
    }

    /* Show a layer. A name that the data does not have is shown as rgb until data with it is loaded. */
    show(name) {
      this.#layer = String(name);
      this.#useLayer();
      this.#changed();
    }

    /* Return {low, high, isLog} of the colours of the shown layer; null for rgb. */
    legend() {
      if (this.#layer === "opacity") return { low: 0, high: 1, isLog: false };
      if (this.#layer === "depth") {
        const [low, high] = this.#depthRange();
        return { low, high, isLog: false };
      }
      const found = this.#shown?.layers.find((layer) => layer.name === this.#layer);
      return found && !BUILT_IN.includes(this.#layer) ? { low: found.low, high: found.high, isLog: found.isLog } : null;
    }

    get camera() {
      return { ...this.#camera, target: [...this.#camera.target] };
    }

    /* Settings that are left out or not finite keep their values. fov is across the shorter side of the picture. */
    set camera(change) {
      const camera = this.#camera;
      for (const name of ["azimuth", "elevation", "distance", "fov"]) {
        if (Number.isFinite(change[name])) camera[name] = change[name];
      }
      if (change.target?.length === 3 && [...change.target].every(Number.isFinite)) camera.target = [...change.target];
      camera.azimuth = ((camera.azimuth % 360) + 360) % 360;
      camera.elevation = clamp(camera.elevation, -90, 90);
      camera.distance = clamp(camera.distance, 1e-4, 1e9);
      camera.fov = clamp(camera.fov, 1, 150);
      this.#isPlaced ||= "distance" in change || "target" in change;
      this.#sort();
      this.#changed();
    }

    get background() {
      return [...this.#background];
    }

    set background(color) {
      this.#background = [...color].map((value) => clamp(Number(value) || 0, 0, 1));
      this.#changed();
    }

    get count() {
      return this.#latest?.count ?? 0;
    }

    get degree() {
      return this.#latest?.degree ?? 0;
    }

    get rotating() {
      return this.#rotating;
    }

    set rotating(value) {
      this.#rotating = Boolean(value);
      this.#changed();
    }

    /* Move the camera back to where it began. */
    reset() {
      const { camera = {} } = this.#options;
      this.#rotating = false;
      this.camera = { ...this.#home, ...camera };
    }

    /* Return the picture as a PNG. */
    snapshot() {
      this.#isMoving = false;
      this.#paint();
      return new Promise((resolve) => this.#canvas.toBlob(resolve, "image/png"));
    }

    destroy() {
      this.#abort.abort();
      this.#observer?.disconnect();
      cancelAnimationFrame(this.#request);
      clearTimeout(this.#restTimer);
      this.#sorting?.close();
      for (const data of [this.#shown, this.#next]) if (data) this.#release(data);
      this.#next?.waiting.forEach((resolve) => resolve());
      this.#shown = this.#next = null;
      this.#gl?.getExtension("WEBGL_lose_context")?.loseContext();
      this.#gl = null;
      this.#canvas.remove();
      this.#message?.remove();
    }

    /* Fill an element with controls: count, layer, colours of the layer, background, rotation, reset and picture. */
    controls(element) {
      const make = (name, properties, ...children) => {
        const made = Object.assign(document.createElement(name), properties);
        made.append(...children);
        return made;
      };
      const [count, low, high] = ["splat-count", "", ""].map((className) => make("span", { className }));
      const choice = make("select", { title: "What the colours show (keys 1 to 9)" });
      choice.setAttribute("aria-label", "What the colours show");
      const ramp = make("i");
      ramp.style.background = SplatView.gradient;
      const legend = make("span", { className: "splat-legend" }, low, ramp, high);
      const swatches = BACKGROUNDS.map(([name, color]) => {
        const swatch = make("button", { type: "button", className: "splat-swatch", title: `${name} background` });
        swatch.setAttribute("aria-label", swatch.title);
        swatch.style.background = `rgb(${color.map((value) => 255 * value).join(" ")})`;
        swatch.onclick = () => { this.background = color; };
        return [swatch, color];
      });
      const button = (text, title, onclick) => make("button", { type: "button", title, onclick }, text);
      const turn = button("Rotate", "Rotate slowly (space)", () => { this.rotating = !this.#rotating; });
      const backgrounds = make("span", { className: "splat-swatches" }, ...swatches.map(([swatch]) => swatch));
      backgrounds.setAttribute("role", "group");
      backgrounds.setAttribute("aria-label", "Background");
      element.classList.add("splat-controls");
      element.replaceChildren(count, make("label", {}, make("span", {}, "Show"), choice), legend,
        make("span", { className: "splat-tools" }, backgrounds, turn,
          button("Reset", "Back to the first view (r)", () => this.reset()),
          button("Save PNG", "Save this picture", () => this.#save())));
      choice.onchange = () => this.show(choice.value);
      const refresh = () => {
        count.textContent = `${this.count.toLocaleString("en")} Gaussian${this.count === 1 ? "" : "s"}`;
        const names = this.layers;
        if ([...choice.options].map((option) => option.value).join("\n") !== names.join("\n")) {
          choice.replaceChildren(...names.map((name) => make("option", { value: name }, name === "rgb" ? "colour" : name)));
        }
        if (choice.value !== this.#layer) choice.value = names.includes(this.#layer) ? this.#layer : "rgb";
        const ends = this.legend();
        legend.hidden = !ends;
        if (ends) {
          low.textContent = short(ends.low);
          high.textContent = short(ends.high);
          legend.title = ends.isLog ? "logarithmic colours" : "linear colours";
        }
        for (const [swatch, color] of swatches) {
          swatch.setAttribute("aria-pressed", color.every((value, i) => value === this.#background[i]));
        }
        turn.setAttribute("aria-pressed", this.#rotating);
      };
      this.#refreshers.push(refresh);
      refresh();
    }

    async #save() {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(await this.snapshot());
      link.download = "view.png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    }

    /* ---- data on the graphics card ---- */

    get #latest() {
      return this.#shown ?? this.#next;
    }

    #build() {
      const gl = this.#gl;
      // 16-bit floats hold sums of many faint Gaussians and colours above 1. Bytes are the fallback.
      this.#isHalf = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
      this.#splats = compile(gl, VERTEX, FRAGMENT);
      this.#screen = compile(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
      const { program, uniforms } = this.#splats;
      gl.useProgram(program);
      gl.uniform1i(uniforms.records, RECORD_UNIT);
      gl.uniform1i(uniforms.rest, REST_UNIT);
      gl.uniform1i(uniforms.levels, LEVEL_UNIT);
      gl.uniform1i(uniforms.order, ORDER_UNIT);
      gl.uniform1i(uniforms.width, this.#textureWidth());
      gl.uniform3fv(uniforms.gradient, GRADIENT.flat());
      gl.useProgram(this.#screen.program);
      gl.uniform1i(this.#screen.uniforms.picture, PICTURE_UNIT);
      // The two triangles of each quad of a batch.
      const corners = [0, 1, 2, 2, 1, 3];
      const indices = Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + corners[i % 6]);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      this.#frame = gl.createFramebuffer();
      this.#picture = this.#order = this.#levels = null;
      this.#pictureSize = [0, 0];
    }

    #textureWidth() {
      return Math.min(4096, this.#gl.getParameter(this.#gl.MAX_TEXTURE_SIZE));
    }

    /* Return a texture for so many texels; at least one, because a texture without any cannot exist. */
    #texture(unit, kind, texels) {
      const gl = this.#gl;
      const texture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
      const width = this.#textureWidth();
      gl.texStorage2D(gl.TEXTURE_2D, 1, kind, texels ? width : 1, Math.max(1, Math.ceil(texels / width)));
      return texture;
    }

    /* Fill the texture that is bound to a unit, row by row, with so many numbers per texel. */
    #fill(unit, format, type, array, perTexel) {
      const gl = this.#gl;
      const [width, texels] = [this.#textureWidth(), array.length / perTexel];
      const rows = Math.floor(texels / width);
      gl.activeTexture(gl.TEXTURE0 + unit);
      const put = (row, across, down) => gl.texSubImage2D(
        gl.TEXTURE_2D, 0, 0, row, across, down, format, type, array.subarray(row * width * perTexel));
      if (rows) put(0, width, rows);
      if (texels % width) put(rows, texels % width, 1);
    }

    #upload(data) {
      const gl = this.#gl;
      data.textures = [[RECORD_UNIT, data.records], [REST_UNIT, data.rest]].map(([unit, array]) => {
        const texture = this.#texture(unit, gl.RGBA32UI, array.length / 4);
        this.#fill(unit, gl.RGBA_INTEGER, gl.UNSIGNED_INT, array, 4);
        return texture;
      });
    }

    #release(data) {
      data.textures?.forEach((texture) => this.#gl?.deleteTexture(texture));
      data.textures = null;
    }

    /* Put the levels of the shown layer on the graphics card. */
    #useLayer() {
      if (this.#levels) this.#gl?.deleteTexture(this.#levels);
      this.#levels = null;
      const found = this.#shown?.layers.find((layer) => layer.name === this.#layer);
      if (!this.#gl || !found || BUILT_IN.includes(this.#layer)) return;
      const gl = this.#gl;
      this.#levels = this.#texture(LEVEL_UNIT, gl.R8UI, found.levels.length);
      this.#fill(LEVEL_UNIT, gl.RED_INTEGER, gl.UNSIGNED_BYTE, found.levels, 1);
    }

    /* ---- depth order ---- */

    #sort() {
      const data = this.#next ?? this.#shown;
      if (!this.#sorting || this.#isSorting || !data) return;
      const axis = pose(this.#camera).forward;
      const along = [data.generation, ...axis].join();
      if (along === this.#sortedAlong) return;
      this.#sortedAlong = along;
      this.#isSorting = true;
      this.#sorting.request(data.generation, axis, this.#spare);
      this.#spare = null;
    }

    #sorted(generation, order) {
      this.#isSorting = false;
      const gl = this.#gl;
      const isNext = this.#next?.generation === generation;
      if (gl && (isNext || this.#shown?.generation === generation)) {
        this.#useOrder(order);
        if (isNext) this.#accept();
        this.#draw(isNext);
      }
      this.#spare = order;
      this.#sort();
    }

    /* Put an order on the graphics card, where it needs one texture that grows and shrinks with the data. */
    #useOrder(order) {
      const gl = this.#gl;
      const rows = Math.ceil(order.length / this.#textureWidth());
      if (!this.#order || rows !== this.#orderRows) {
        if (this.#order) gl.deleteTexture(this.#order);
        this.#order = this.#texture(ORDER_UNIT, gl.R32UI, rows * this.#textureWidth());
        this.#orderRows = rows;
      }
      gl.activeTexture(gl.TEXTURE0 + ORDER_UNIT);
      gl.bindTexture(gl.TEXTURE_2D, this.#order);
      this.#fill(ORDER_UNIT, gl.RED_INTEGER, gl.UNSIGNED_INT, order, 1);
    }

    /* Make the next data the shown data, and resolve the promises of its load. */
    #accept() {
      const [before, data] = [this.#shown, this.#next];
      this.#shown = data;
      this.#next = null;
      if (before) this.#release(before);
      this.#useLayer();
      this.#removeMessage();
      if (!before?.count) this.#frameObject(data);
      const waiting = data.waiting.splice(0);
      queueMicrotask(() => { waiting.forEach((resolve) => resolve()); this.#notify(); });
    }

    /* Move the camera to where the whole object is visible, unless the page has placed it. */
    #frameObject({ focus, radius }) {
      const { fov } = this.#camera;
      const fitting = Number((1.026 * radius / Math.sin(fov * DEGREE / 2)).toPrecision(3));
      this.#home = { ...HOME, fov, distance: fitting, target: [...focus] };
      if (!this.#isPlaced) Object.assign(this.#camera, { distance: this.#home.distance, target: [...focus] });
    }

    #depthRange() {
      const data = this.#latest;
      const { eye, forward } = pose(this.#camera);
      const { focus, radius } = data ?? { focus: [0, 0, 0], radius: 1 };
      const center = focus.reduce((sum, value, i) => sum + forward[i] * (value - eye[i]), 0);
      const low = Math.max(center - radius, NEAR * Math.min(1, radius));
      return [low, Math.max(center + radius, low + 1e-3 * radius)];
    }

    /* ---- drawing ---- */

    #changed() {
      this.#draw();
      this.#notify();
    }

    #notify() {
      this.#refreshers.forEach((refresh) => refresh());
      this.onchange?.();
    }

    /* Draw soon, or now. Drawing now works in a hidden page too, where no frames are requested. */
    #draw(isNow = false) {
      if (isNow) {
        // This picture replaces one that is due soon, but not the next one of a rotation.
        if (!this.#rotating) {
          cancelAnimationFrame(this.#request);
          this.#request = 0;
        }
        this.#paint();
      } else this.#request ||= requestAnimationFrame((time) => this.#tick(time));
    }

    #tick(time) {
      this.#request = 0;
      const passed = time - this.#lastTime;
      this.#lastTime = time;
      if (this.#isMoving && this.#wasMoving) this.#adapt(passed);
      this.#wasMoving = this.#isMoving;
      if (this.#rotating) {
        this.#moved();
        this.camera = { azimuth: this.#camera.azimuth + 0.02 * Math.min(passed, 100) };
      }
      this.#paint();
    }

    /* Make moving pictures coarser on slow machines. When the camera rests, the picture is sharp again. */
    #adapt(passed) {
      this.#interval = (this.#interval + passed) / 2;
      // The time of a picture is about proportional to its pixels.
      const change = this.#interval > SLOW ? Math.min(2, Math.sqrt(this.#interval / SLOW))
        : this.#interval < SLOW / 2 ? 0.9 : 1;
      this.#coarseness = clamp(this.#coarseness * change, 1, COARSEST);
    }

    #moved() {
      this.#isMoving = true;
      clearTimeout(this.#restTimer);
      this.#restTimer = setTimeout(() => {
        this.#isMoving = false;
        this.#draw();
      }, 200 + 2 * this.#interval);
    }

    #resize() {
      const gl = this.#gl;
      const [width, height] = [this.#canvas.clientWidth, this.#canvas.clientHeight];
      const density = Math.min(devicePixelRatio || 1, DENSITY_LIMIT, Math.sqrt(PIXELS_LIMIT / Math.max(1, width * height)));
      const size = [width, height].map((length) => Math.max(1, Math.round(length * density)));
      if (this.#canvas.width !== size[0] || this.#canvas.height !== size[1]) {
        [this.#canvas.width, this.#canvas.height] = size;
      }
      const coarse = this.#isMoving ? this.#coarseness : 1;
      const small = size.map((length) => Math.max(1, Math.round(length / coarse)));
      if (small[0] !== this.#pictureSize[0] || small[1] !== this.#pictureSize[1]) {
        this.#pictureSize = small;
        this.#attach();
      }
      return small;
    }

    /* Make the picture that the Gaussians are drawn into. */
    #attach() {
      const gl = this.#gl;
      if (this.#picture) gl.deleteTexture(this.#picture);
      this.#picture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + PICTURE_UNIT);
      gl.bindTexture(gl.TEXTURE_2D, this.#picture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, this.#isHalf ? gl.RGBA16F : gl.RGBA8, ...this.#pictureSize);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
      for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.#frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.#picture, 0);
      if (this.#isHalf && gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
        this.#isHalf = false;
        this.#attach();
      }
    }

    #paint() {
      const gl = this.#gl;
      if (!gl || gl.isContextLost()) return;
      const size = this.#resize();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.#frame);
      gl.viewport(0, 0, ...size);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      if (this.#shown?.count) this.#paintSplats(size);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      const full = [this.#canvas.width, this.#canvas.height];
      gl.viewport(0, 0, ...full);
      gl.useProgram(this.#screen.program);
      gl.uniform2f(this.#screen.uniforms.scale, 1 / full[0], 1 / full[1]);
      gl.uniform3fv(this.#screen.uniforms.background, this.#background);
      gl.activeTexture(gl.TEXTURE0 + PICTURE_UNIT);
      gl.bindTexture(gl.TEXTURE_2D, this.#picture);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      this.onframe?.();
    }

    #paintSplats(size) {
      const gl = this.#gl;
      const { textures, degree, count } = this.#shown;
      const { program, uniforms } = this.#splats;
      const { eye, right, down, forward } = pose(this.#camera);
      gl.useProgram(program);
      const bound = [[RECORD_UNIT, textures[0]], [REST_UNIT, textures[1]], [LEVEL_UNIT, this.#levels ?? textures[1]],
        [ORDER_UNIT, this.#order], [PICTURE_UNIT, null]];
      for (const [unit, texture] of bound) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, texture);
      }
      const mode = BUILT_IN.indexOf(this.#layer);
      gl.uniform1i(uniforms.mode, mode >= 0 ? mode : this.#levels ? 3 : 0);
      gl.uniform1i(uniforms.count, count);
      gl.uniform1i(uniforms.degree, degree);
      gl.uniformMatrix3fv(uniforms.rotation, true, [...right, ...down, ...forward]);
      gl.uniform3fv(uniforms.eye, eye);
      gl.uniform2fv(uniforms.size, size);
      gl.uniform2fv(uniforms.range, this.#depthRange());
      gl.uniform1f(uniforms.near, NEAR * Math.min(1, this.#shown.radius));
      gl.uniform1f(uniforms.focal, 0.5 * Math.min(...size) / Math.tan(this.#camera.fov * DEGREE / 2));
      gl.enable(gl.BLEND);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(count / BATCH));
      gl.disable(gl.BLEND);
    }

    /* ---- messages ---- */

    #showMessage(text) {
      this.#removeMessage();
      const message = document.createElement("p");
      message.className = "splat-message";
      message.setAttribute("role", "alert");
      message.textContent = text;
      Object.assign(message.style, { position: "absolute", inset: "auto 0", top: "35%", margin: "0 auto", padding: "1em 1.2em",
        width: "fit-content", maxWidth: "min(34em, 85%)", boxSizing: "border-box", borderRadius: "10px",
        background: "#fff", color: "#1b1c1e", font: "16px/1.5 system-ui, sans-serif", overflowWrap: "anywhere",
        boxShadow: "0 2px 16px rgb(0 0 0 / .25)" });
      if (getComputedStyle(this.#element).position === "static") this.#element.style.position = "relative";
      this.#element.append(message);
      this.#message = message;
    }

    #removeMessage() {
      this.#message?.remove();
      this.#message = null;
    }

    /* ---- mouse, touch and keyboard ---- */

    #listen() {
      const canvas = this.#canvas;
      const on = (target, name, handler, options = {}) =>
        target.addEventListener(name, handler, { signal: this.#abort.signal, ...options });
      on(canvas, "pointerdown", (event) => this.#press(event));
      on(canvas, "pointermove", (event) => this.#drag(event));
      for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) on(canvas, name, (event) => this.#lift(event));
      on(canvas, "wheel", (event) => this.#wheel(event), { passive: false });
      on(canvas, "contextmenu", (event) => event.preventDefault());
      on(canvas, "webglcontextlost", (event) => event.preventDefault());
      on(canvas, "webglcontextrestored", () => this.#restore());
      const { keyboard } = this.#options;
      if (keyboard) on(keyboard === true ? canvas : keyboard, "keydown", (event) => this.#key(event));
    }

    /* Build and upload everything again: a reset of the graphics card has removed it. */
    #restore() {
      this.#build();
      for (const data of [this.#shown, this.#next]) if (data) this.#upload(data);
      this.#useLayer();
      this.#sortedAlong = null;
      this.#sort();
    }

    #press(event) {
      this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      this.#canvas.setPointerCapture(event.pointerId);
      this.#canvas.focus({ preventScroll: true });
      this.#canvas.style.cursor = "grabbing";
      if (this.#rotating) this.rotating = false;
    }

    #lift(event) {
      this.#pointers.delete(event.pointerId);
      if (!this.#pointers.size) this.#canvas.style.cursor = "grab";
    }

    #drag(event) {
      const before = this.#pointers.get(event.pointerId);
      if (!before) return;
      const now = { x: event.clientX, y: event.clientY };
      const [dx, dy] = [now.x - before.x, now.y - before.y];
      this.#pointers.set(event.pointerId, now);
      const others = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      if (others.length > 1) return;
      this.#moved();
      if (others.length === 1) {
        // Two fingers: their distance zooms, and their centre moves the object.
        const apart = ({ x, y }) => Math.max(Math.hypot(x - others[0].x, y - others[0].y), 1);
        this.#zoom(apart(before) / apart(now));
        this.#pan(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 6) {
        this.#pan(dx, dy);
      } else {
        this.#orbit(dx, dy);
      }
    }

    #orbit(dx, dy) {
      const { azimuth, elevation } = this.#camera;
      this.camera = { azimuth: azimuth - 0.4 * dx, elevation: elevation + 0.4 * dy };
    }

    #zoom(factor) {
      const radius = this.#latest?.radius ?? 1;
      this.camera = { distance: clamp(this.#camera.distance * factor, 0.02 * radius, 100 * radius) };
    }

    /* Move the object with the pointer: dx, dy are in CSS pixels. */
    #pan(dx, dy) {
      const { right, down } = pose(this.#camera);
      const { distance, fov, target } = this.#camera;
      const shorter = Math.max(1, Math.min(this.#canvas.clientWidth, this.#canvas.clientHeight));
      const unit = 2 * distance * Math.tan(fov * DEGREE / 2) / shorter;
      this.camera = { target: target.map((value, i) => value - unit * (dx * right[i] + dy * down[i])) };
    }

    #wheel(event) {
      const isOurs = !this.#options.embedded || event.ctrlKey || event.metaKey || document.activeElement === this.#canvas;
      if (!isOurs) return;
      event.preventDefault();
      const unit = [1, 16, 200][event.deltaMode] ?? 1; // pixels, lines or pages
      this.#moved();
      // A pinch on a touchpad arrives as a wheel with Ctrl and small steps.
      this.#zoom(Math.exp(clamp(event.deltaY * unit, -300, 300) * (event.ctrlKey ? 0.01 : 0.0015)));
    }

    #key(event) {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const isIn = (names) => event.target instanceof Element && event.target.closest(names);
      if (isIn("input, select, textarea") || (event.key === " " && isIn("button, summary, a"))) return;
      const step = event.shiftKey ? 2.5 : 12; // CSS pixels of a drag
      const moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
      const layer = this.layers[Number(event.key) - 1];
      if (moves[event.key]) this.#orbit(...moves[event.key]);
      else if (event.key === "+" || event.key === "=") this.#zoom(1 / 1.1);
      else if (event.key === "-" || event.key === "_") this.#zoom(1.1);
      else if (event.key === "r" || event.key === "R") this.reset();
      else if (event.key === " ") this.rotating = !this.rotating;
      else if (layer) this.show(layer);
      else return;
      this.#moved();
      event.preventDefault();
    }
  }

  /* Return the centres of the Gaussians, three numbers each. */
  function positions({ records, count }) {
    const floats = new Float32Array(records.buffer, records.byteOffset, records.length);
    const points = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      points[3 * i] = floats[8 * i];
      points[3 * i + 1] = floats[8 * i + 1];
      points[3 * i + 2] = floats[8 * i + 2];
    }
    return points;
  }

  return SplatView;
})();
