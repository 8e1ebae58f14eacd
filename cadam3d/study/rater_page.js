// The page of a study. A rater answers all questions about one pair of clips after the other. Both clips are lists
// of pictures, drawn by one clock, so they always show the same angle.
"use strict";

const $ = (id) => document.getElementById(id);
const study = JSON.parse($("study").textContent);
const { trials, questions } = study;
const SIDES = ["first", "second"];
const TOTAL = trials.length * questions.length;
const PLACE = `study-${study.study}`; // in the storage of the browser
const LONGEST_PAUSE = 600; // seconds that count as thinking about one answer
const NOTICE_MS = 6000;

// --- what one rater sees ---------------------------------------------------------------------------------------
// The seed of the study fixes the order and the sides. A rater begins at a place that depends on the name, and
// every second name sees the sides exchanged, so that neither order nor side depends on the pair over all raters.

let rater = null; // name, session, saves, isSaved, answers: one per step, in the order in which this rater sees them
let step = 0;

function hash(text) {
  let value = 2166136261;
  for (const byte of new TextEncoder().encode(text)) value = Math.imul(value ^ byte, 16777619) >>> 0;
  return value;
}

function shown(at) {
  const value = hash(rater.name.toLowerCase());
  const number = (Math.floor(at / questions.length) + (value >>> 1)) % trials.length;
  const { prompt, clips } = trials[number];
  return { number, prompt, clips: value % 2 ? [clips[1], clips[0]] : clips, question: questions[at % questions.length] };
}

function newSession() {
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

// --- keeping the answers ---------------------------------------------------------------------------------------

let isKept = true; // whether the browser keeps the answers

function keep() {
  try {
    localStorage.setItem(PLACE, JSON.stringify({ rater, step }));
  } catch {
    if (!isKept) return;
    isKept = false;
    notice("This browser cannot keep your answers. Please do not close or reload this page before you have saved them.");
  }
}

function restore() {
  try {
    const kept = JSON.parse(localStorage.getItem(PLACE));
    if (!kept?.rater?.name || !Array.isArray(kept.rater.answers)) return;
    rater = kept.rater;
    step = Math.min(Math.max(Math.trunc(kept.step) || 0, 0), TOTAL);
  } catch { /* nothing usable was kept */ }
}

// Answers that neither the browser nor a file has are not closed without a question.
addEventListener("beforeunload", (event) => {
  if (!isKept && rater?.answers.length && !rater.isSaved) event.preventDefault();
});

// The page may be open twice in one browser. Otherwise, the second window would write over the answers of the first.
addEventListener("storage", (event) => {
  if (event.key !== PLACE) return;
  rater = null;
  step = 0;
  restore();
  show();
});

function forget() {
  try {
    localStorage.removeItem(PLACE);
  } catch { /* then nothing was kept either */ }
}

// --- the file of answers ---------------------------------------------------------------------------------------

function written() {
  const answers = [];
  for (let at = 0; at < TOTAL; at++) {
    if (!rater.answers[at]) continue;
    const { number, clips, question } = shown(at);
    answers.push({ trial: number, shown: clips, question: question.name, ...rater.answers[at] });
  }
  const { name, session, saves } = rater;
  return JSON.stringify({ kind: "study answers", version: 1, study: study.study, rater: name, session, saves, answers }, null, 1);
}

function save() {
  rater.saves += 1;
  rater.isSaved = true;
  keep();
  const text = written();
  const link = document.createElement("a");
  const name = rater.name.replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "").slice(0, 40);
  link.download = `answers-${name || "rater"}-${rater.session.slice(0, 4)}.json`;
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  $("text").value = text;
  offerNext();
  notice(`Saved as ${link.download}`);
}

// --- clips and their clock -------------------------------------------------------------------------------------

const loaded = new Map(); // number of a clip -> promise of its pictures
let playing = []; // the pictures of both sides
let angle = 0; // turns since the front, in [0, 1)
let paused = matchMedia("(prefers-reduced-motion: reduce)").matches;
let before = null; // time of the last drawing, in milliseconds
let dragged = null; // where the pointer was, in CSS pixels
let drawn = -1;

function load(number) {
  if (!loaded.has(number)) {
    const frames = $(`clip-${number}`).textContent.split("\n");
    loaded.set(number, Promise.all(frames.map(async (frame) => {
      const image = new Image();
      image.src = `data:image/webp;base64,${frame}`;
      await image.decode();
      return createImageBitmap(image);
    })));
  }
  return loaded.get(number);
}

function release(kept) {
  for (const [number, pictures] of loaded) {
    if (kept.includes(number)) continue;
    loaded.delete(number);
    pictures.then((all) => all.forEach((picture) => picture.close()), () => {});
  }
}

async function play(clips, next) {
  playing = [];
  drawn = -1;
  release([...clips, ...next]);
  try {
    const both = await Promise.all(clips.map(load));
    if (step < TOTAL && shown(step).clips.join() !== clips.join()) return; // the rater has moved on
    for (const [i, side] of SIDES.entries()) {
      $(side).width = both[i][0].width;
      $(side).height = both[i][0].height;
    }
    playing = both;
    replay();
    next.forEach((number) => load(number).catch(() => {}));
  } catch {
    notice("A picture of this pair cannot be shown in this browser. Please open the page in another one.");
  }
}

function replay() {
  angle = 0;
  before = null;
}

function pause(is) {
  paused = is;
  $("pause").textContent = paused ? "Play" : "Pause";
}

function draw(now) {
  requestAnimationFrame(draw);
  if (!playing.length) return;
  if (before !== null && !paused && dragged === null) angle += (now - before) / 1000 / study.seconds;
  before = now;
  angle -= Math.floor(angle);
  const frame = Math.min(Math.floor(angle * playing[0].length), playing[0].length - 1);
  if (frame === drawn) return;
  drawn = frame;
  for (const [i, side] of SIDES.entries()) {
    $(side).getContext("2d").drawImage(playing[i][frame], 0, 0);
    $(side).dataset.frame = frame;
  }
}

for (const side of SIDES) {
  $(side).addEventListener("pointerdown", (event) => {
    dragged = event.clientX;
    $(side).setPointerCapture(event.pointerId);
  });
  $(side).addEventListener("pointermove", (event) => {
    if (dragged === null) return;
    angle += (event.clientX - dragged) / $(side).clientWidth / 2;
    dragged = event.clientX;
  });
  for (const name of ["pointerup", "pointercancel"]) $(side).addEventListener(name, () => { dragged = null; });
}

// --- screens ---------------------------------------------------------------------------------------------------

// Another person may begin in this browser as soon as a file has all answers, also if questions are left.
function offerNext() {
  for (const name of ["next-person", "next-now"]) $(name).hidden = !rater?.isSaved;
}

let since = 0; // when the question was shown, in milliseconds
let pair = -1;

function screen(name) {
  for (const each of ["start", "trial", "end"]) $(each).hidden = each !== name;
}

function show() {
  offerNext();
  if (rater === null) {
    screen("start");
    $("name").focus();
    return;
  }
  if (step >= TOTAL) {
    screen("end");
    pair = -1;
    playing = [];
    release([]);
    $("text").value = written();
    $("save").focus();
    return;
  }
  screen("trial");
  const { number, prompt, clips, question } = shown(step);
  const place = Math.floor(step / questions.length);
  if (pair !== number) {
    pair = number;
    const ahead = (place + 1) * questions.length;
    play(clips, ahead < TOTAL ? shown(ahead).clips : []);
  }
  $("place").textContent = `Pair ${place + 1} of ${trials.length} · question ${(step % questions.length) + 1} of ${questions.length}`;
  $("who").textContent = rater.name; // a person who continues by mistake for another one should notice
  $("progress").max = TOTAL;
  $("progress").value = rater.answers.filter(Boolean).length;
  $("prompt").textContent = prompt;
  $("question").textContent = question.text;
  const chosen = rater.answers[step]?.chosen;
  for (const [i, side] of SIDES.entries()) $(`choose-${side}`).setAttribute("aria-pressed", String(chosen === clips[i]));
  $("back").disabled = step === 0;
  // Away from the buttons, so that the next press of the space bar is not another answer.
  $("question").focus();
  since = performance.now();
}

function choose(side) {
  if (!playing.length) return; // the objects are not shown yet
  const seconds = Math.min(Math.round((performance.now() - since) / 100) / 10, LONGEST_PAUSE);
  rater.answers[step] = { chosen: shown(step).clips[side], seconds };
  rater.isSaved = false;
  step += 1;
  keep();
  show();
}

function back() {
  if (step === 0) return;
  step -= 1;
  keep();
  show();
}

let fading = 0;

function notice(text) {
  clearTimeout(fading);
  $("notice").hidden = false;
  $("notice").textContent = text;
  fading = setTimeout(() => { $("notice").hidden = true; }, NOTICE_MS);
}

// --- input -----------------------------------------------------------------------------------------------------

$("begin").addEventListener("submit", (event) => {
  event.preventDefault();
  const name = $("name").value.normalize().replace(/\s+/g, " ").trim();
  if (!name) {
    $("name").value = "";
    $("begin").reportValidity();
    return;
  }
  rater = { name, session: newSession(), saves: 0, isSaved: false, answers: [] };
  step = 0;
  keep();
  show();
});

for (const [i, side] of SIDES.entries()) $(`choose-${side}`).addEventListener("click", () => choose(i));
$("back").addEventListener("click", back);
$("review").addEventListener("click", back);
$("replay").addEventListener("click", replay);
$("pause").addEventListener("click", () => pause(!paused));
$("save").addEventListener("click", save);
$("save-now").addEventListener("click", save);
function nextPerson() {
  if (!confirm("Remove these answers from this browser, and let another person begin?")) return;
  forget();
  rater = null;
  step = 0;
  $("begin").reset();
  show();
}

for (const name of ["next-person", "next-now"]) $(name).addEventListener("click", nextPerson);

const KEYS = {
  ArrowLeft: () => choose(0), 1: () => choose(0), ArrowRight: () => choose(1), 2: () => choose(1),
  Backspace: back, p: () => pause(!paused), P: () => pause(!paused), " ": replay,
};

document.addEventListener("keydown", (event) => {
  if ($("trial").hidden || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  // On a button, the space bar presses that button.
  if (event.key === " " && event.target.tagName === "BUTTON") return;
  if (!(event.key in KEYS)) return;
  event.preventDefault();
  KEYS[event.key]();
});

pause(paused);
restore();
show();
requestAnimationFrame(draw);
