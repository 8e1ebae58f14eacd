// The page of cadam3d view: it requests the state of the run about once a second, and draws what has changed.
// SplatView, which draws the Gaussians, is in viewer.js.
"use strict";

const POLL_MS = 700, RETRY_MS = 2000, TIMEOUT_MS = 60000;
const STATUS = {
  training: "training", paused: "paused", ending: "writing the outputs", busy: "busy", idle: "not running",
};
const SPEED_SAMPLES = 20;

const $ = (id) => document.getElementById(id);
const view = new SplatView($("view"));
view.controls($("controls"));
let state = null;
let charts = [];
let recent = []; // states of this process, oldest first: the newest numbers of the charts, and the speed
const shown = { picture: null, charts: null };
let loading = false;
let savedBefore = null; // the saved steps at the time of the last click on "Save now"

// --- requests --------------------------------------------------------------------------------------------------

async function get(name) {
  const answer = await fetch(name, { signal: AbortSignal.timeout(TIMEOUT_MS) });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer;
}

async function poll() {
  let wait = POLL_MS;
  // A hidden page sends no requests, so that it costs the training no time.
  if (!document.hidden) {
    try {
      state = await (await get("state")).json();
      remember(state);
      if (state.charts !== undefined && state.charts !== shown.charts) {
        charts = await (await get("charts")).json();
        shown.charts = state.charts;
      }
      showPicture();
      lost("");
    } catch (error) {
      wait = RETRY_MS;
      lost("The connection is lost. Trying again. If cadam3d view has ended, start it again and open its new address.");
    }
    draw();
  }
  setTimeout(poll, wait);
}

function lost(text) {
  if (text) state = state && { ...state, status: "lost" };
  notice(text);
}

function notice(text) {
  $("notice").hidden = !text;
  $("notice").textContent = text;
}

function remember(now) {
  const last = recent.at(-1);
  if (!now.process || (last && (last.process !== now.process || last.step > now.step))) recent = [];
  if (now.process && recent.at(-1)?.step !== now.step) recent.push(now);
  if (recent.length > 2000) recent.splice(1, 1000);
}

// The picture is loaded beside the polls, because a large one takes longer than they do.
async function showPicture() {
  const name = state.picture;
  if (loading || !name || name === shown.picture) return;
  loading = true;
  try {
    await view.load(await (await get("picture")).arrayBuffer());
    shown.picture = name;
  } catch (error) {
    message(`The picture cannot be shown: ${error.message}`);
  } finally {
    loading = false;
  }
}

async function ask(request) {
  savedBefore = request === "save" ? new Set(state.saved) : savedBefore;
  try {
    const answer = await fetch(request, { method: "POST", body: state.process });
    message(answer.ok ? "" : (await answer.text()).trim());
    if (answer.ok && request !== "resume") state.asked = [...(state.asked || []), request];
    if (request === "resume") state.asked = (state.asked || []).filter((each) => each !== "pause");
  } catch (error) {
    message("The request did not arrive.");
  }
  drawButtons();
}

// --- drawing --------------------------------------------------------------------------------------------------

function draw() {
  if (!state) return;
  document.title = state.title;
  $("title").textContent = state.title;
  $("status").textContent = state.kind === "file" ? "file" : STATUS[state.status] || "not connected";
  $("status").dataset.status = state.status;
  const isRun = state.kind === "run";
  $("buttons").hidden = !isRun;
  if (!isRun) return;
  if (state.status === "busy") notice("A process uses the folder of this run. It is starting, or trains without callback=live.");
  if (state.is_writable === false) {
    notice("You cannot write into the folder of this run. Without that, neither the current Gaussians nor the buttons are available.");
  }
  drawButtons();
  drawFacts();
  drawFiles();
  $("charts").replaceChildren(...charts.map(drawChart));
}

function drawButtons() {
  const isLive = (state.status === "training" || state.status === "paused") && state.is_writable !== false;
  const asked = isLive ? state.asked || [] : [];
  const isPaused = state.status === "paused";
  const [pause, save, stop] = ["pause", "save", "stop"].map($);
  const isSwitching = isPaused !== asked.includes("pause");
  pause.textContent = isLive && isSwitching ? (isPaused ? "Resuming…" : "Pausing…") : isPaused ? "Resume" : "Pause";
  pause.disabled = !isLive || asked.includes("stop");
  pause.dataset.request = asked.includes("pause") ? "resume" : "pause";
  save.textContent = asked.includes("save") ? "Saving…" : "Save now";
  save.disabled = !isLive || asked.includes("save") || asked.includes("stop");
  stop.textContent = asked.includes("stop") ? "Stopping…" : "Stop";
  stop.disabled = !isLive || asked.includes("stop");
  if (savedBefore && isLive && !asked.includes("save")) {
    const step = state.saved.find((each) => !savedBefore.has(each));
    const known = step ?? state.saved.at(-1);
    message(known === undefined ? "Not saved. The output of the run has the reason." : `Saved step ${known}.`);
    savedBefore = null;
  }
}

function message(text) { $("message").textContent = text; }

function drawFacts() {
  const { step, total_steps: total, num_gaussians: count, loss, outcome } = state;
  const isLive = state.status === "training" || state.status === "paused";
  const pace = speed();
  const facts = [
    ["Step", `${step ?? 0}${total ? ` / ${total}` : ""}`],
    ["Gaussians", count === null || count === undefined ? "" : count.toLocaleString("en")],
    ["Loss", loss === null || loss === undefined ? "" : short(loss)],
    ["Speed", pace ? `${short(pace)} steps/s` : ""],
    ["Time left", isLive && pace && total ? duration((total - step) / pace) : ""],
    ["Training time", state.seconds ? duration(state.seconds) : ""],
    ["Outcome", isLive ? "" : (outcome || "").replaceAll("_", " ")],
    ["PSNR", !isLive && state.psnr ? `${state.psnr.toFixed(2)} dB` : ""],
    ["Continue with", state.status === "idle" && outcome !== "finished" && step < total ? state.resume : ""],
  ];
  $("facts").replaceChildren(...facts.filter(([, text]) => text).flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  $("progress").hidden = !total;
  $("progress").value = total ? Math.min(step / total, 1) : 0;
}

function speed() {
  const samples = recent.slice(-SPEED_SAMPLES);
  const [first, last] = [samples[0], samples.at(-1)];
  if (first && last.seconds > first.seconds) return (last.step - first.step) / (last.seconds - first.seconds);
  return state.seconds ? state.step / state.seconds : 0;
}

function drawFiles() {
  const files = [];
  if (state.has_report) files.push(link("Report of the run", "report"));
  if (state.has_asset) files.push(link("asset.ply", "asset.ply", "asset.ply"));
  for (const step of [...state.saved].reverse()) {
    const name = `step_${String(step).padStart(7, "0")}.ply`;
    files.push(link(`saved/${name}`, `saved/${step}`, name));
  }
  $("files").replaceChildren(...files);
}

function link(text, address, file) {
  const anchor = element("a", text);
  anchor.href = address;
  if (file) anchor.download = file;
  else [anchor.target, anchor.rel] = ["_blank", "noopener"];
  const item = document.createElement("li");
  item.append(anchor);
  return item;
}

// --- charts ---------------------------------------------------------------------------------------------------

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [330, 112, 44, 16, 8];

function drawChart(chart) {
  const lines = chart.curves.map((curve) => ({ ...curve, points: extended(curve.points, curve.key) }));
  const band = chart.band.map((bound) => extended(bound.points, bound.key));
  const all = [...lines.flatMap((line) => line.points), ...band.flat()];
  if (!all.length) return "";
  const values = all.map((point) => point[1]);
  const isLog = chart.log_y && Math.min(...values) > 0;
  const scale = isLog ? Math.log10 : (value) => value;
  const [lowX, highX] = [0, Math.max(state.total_steps || 0, ...all.map((point) => point[0]), 1)];
  let [low, high] = [Math.min(...values.map(scale)), Math.max(...values.map(scale))];
  if (!isLog && low > 0 && low < 0.6 * high) low = 0;
  if (high === low) [low, high] = isLog || low <= 0 ? [low - 1, high + 1] : [0, 1.25 * high];
  const x = (step) => LEFT + ((step - lowX) / (highX - lowX)) * (WIDTH - LEFT - 4);
  const y = (value) => HEIGHT - BOTTOM - ((scale(value) - low) / (high - low)) * (HEIGHT - BOTTOM - TOP);
  const text = (value) => (chart.percent ? `${short(100 * value)} %` : short(value));

  const svg = shape("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": chart.title });
  for (const part of [0, 0.5, 1]) {
    const value = isLog ? 10 ** (low + part * (high - low)) : low + part * (high - low);
    svg.append(shape("line", { class: "grid", x1: LEFT, x2: WIDTH - 4, y1: y(value), y2: y(value) }));
    svg.append(shape("text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, text(value)));
  }
  svg.append(shape("text", { x: LEFT, y: HEIGHT - 2 }, "0"));
  svg.append(shape("text", { x: WIDTH - 4, y: HEIGHT - 2, "text-anchor": "end" }, `step ${highX}`));
  const path = (points) => points.map(([step, value], i) => `${i ? "L" : "M"}${x(step).toFixed(1)} ${y(value).toFixed(1)}`).join("");
  if (band.length === 2 && band[0].length) {
    svg.append(shape("path", { class: "band", d: `${path(band[0])}${path(band[1].toReversed()).replace("M", "L")}Z` }));
  }
  lines.forEach((line, index) => {
    svg.append(shape("path", { class: line.is_threshold ? "threshold" : `curve-${index % 3}`, d: path(line.points) }));
  });

  const caption = element("figcaption", chart.title);
  const last = lines[0].points.at(-1);
  if (last) caption.append(element("span", chart.percent ? text(last[1]) : short(last[1])));
  const figure = document.createElement("figure");
  figure.title = chart.caption;
  figure.append(caption, svg);
  const keys = [...lines.map((line) => line.label), chart.band_label].filter(Boolean);
  if (keys.length > 1) figure.append(Object.assign(element("div", keys.join(" · ")), { className: "keys" }));
  return figure;
}

// The log has every tenth step and the refinements; this page adds the states that it has received in between.
function extended(points, key) {
  const last = points.length ? points.at(-1)[0] : -1;
  const more = recent.map((now) => [now.step, now.statistics[key] ?? now[key]]);
  return [...points, ...more.filter(([step, value]) => step > last && typeof value === "number")];
}

// --- small things ---------------------------------------------------------------------------------------------

function element(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

function shape(name, attributes, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

function short(value) {
  const size = Math.abs(value);
  for (const [factor, suffix] of [[1e9, "G"], [1e6, "M"], [1e4, "k"]]) {
    if (size >= factor) return `${+(value / (suffix === "k" ? 1e3 : factor)).toPrecision(3)}${suffix}`;
  }
  return size !== 0 && size < 1e-3 ? value.toExponential(1) : `${+value.toPrecision(size < 1e3 ? 3 : 4)}`;
}

function duration(seconds) {
  const [hours, minutes] = [Math.floor(seconds / 3600), Math.floor(seconds / 60) % 60];
  if (hours) return `${hours} h ${minutes} min`;
  return minutes ? `${minutes} min ${Math.floor(seconds % 60)} s` : `${Math.round(seconds)} s`;
}

$("pause").onclick = () => ask($("pause").dataset.request);
$("save").onclick = () => ask("save");
$("stop").onclick = () => ask("stop");
poll();
