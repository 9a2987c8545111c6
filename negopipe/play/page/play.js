// The game: asks the server for one control step after the other, draws between them, replays what was driven.
"use strict";

const INVITATION = "Drive the dark car to its target. The other one predicts you, and decides anew five times a second.";
const INVITATION_OF_TWO = "Two people at one page: the dark car and the teal car, each to its target.";
const $ = id => document.getElementById(id);
const KEPT = "negopipe-encounter";  // in the session's storage: the encounter that a page loaded anew goes on with
const COUNTS = 3, COUNT_S = 0.6, RETRY_MS = 1000;

const view = new StreetView($("view"));
const game = {
  menu: null, shown: null, frames: [], phase: "menu",
  at_s: 0,          // time in the encounter that is drawn
  lead_s: 0.12,     // time before a frame is drawn at which it is asked for
  rate: 1,          // of the drawn time to real time: below 1 where the machine is too slow, rather than in jerks
  waiting: false,   // a step has been asked for
  horizon: {person: null, opponent: null},  // of people who drive by a horizon
  playing: false, result: null, starts_at: null, run: 0,
};
const measured = {drawn: [], late: 0};  // times of the latest drawings, ms; frames that came too late
window.negopipe = {game, measured, fps: () => measured.drawn.filter(at => at > performance.now() - 1000).length};

class ServerError extends Error {
  constructor(status, message) { super(message); this.status = status; }
}

async function ask(path, body) {
  const options = body === undefined ? {} :
    {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body)};
  const response = await fetch(`/api/${path}`, options);
  const told = await response.json();
  if (!response.ok) throw new ServerError(response.status, told.error);
  return told;
}

// As `ask`, again and again while the server does not answer: a step that is asked for twice is made once.
async function insist(path, body) {
  for (;;) {
    try {
      const told = await ask(path, body);
      trouble(null);
      return told;
    } catch (error) {
      if (error instanceof ServerError) {
        trouble(null);
        throw error;
      }
      trouble("The server does not answer. Is `make play` still running? Trying again …");
      await new Promise(done => setTimeout(done, RETRY_MS));
    }
  }
}

function trouble(text) {
  $("trouble").hidden = !text;
  $("trouble").textContent = text ?? "";
}

function enter(phase, headline = "", hint = "") {
  game.phase = document.body.dataset.phase = phase;
  $("headline").textContent = headline;
  $("hint").textContent = hint;
  const is_under_way = ["drive", "ready", "paused"].includes(phase);
  for (const each of $("choices").elements) each.disabled = is_under_way && each.id !== "start";
  $("start").textContent = is_under_way ? "Give up" : "Drive";
  $("start").classList.toggle("plain", is_under_way);
  $("count").textContent = "";
}

// --- menu and results

function fill(select, choices) {
  select.replaceChildren(...choices.map(({name, label}) => new Option(label, name)));
}

const labelOf = (list, name) => list.find(each => each.name === name)?.label ?? name;

function tell(results) {
  const cell = (text, row) => { const td = document.createElement("td"); td.textContent = text; row.append(td); };
  if (!results.length) {
    $("rows").innerHTML = '<tr class="none"><td colspan="7">no encounter yet</td></tr>';
    return;
  }
  $("rows").replaceChildren(...results.map(each => {
    const row = document.createElement("tr");
    if (each.opponent === $("opponent").value) row.className = "current";
    const crashes = each.collision + each.social_collision, stuck = each.deadlock + each.timeout;
    const values = [each.opponent.replaceAll("_", " "), each.n, each.success, each.person_first, crashes, stuck,
      each.mean_time_s === null ? "–" : `${each.mean_time_s.toFixed(1)} s`];
    values.forEach(value => cell(value, row));
    return row;
  }));
  game.menu.results = results;
}

function control() { return document.querySelector("input[name=control]:checked").value; }

function setControl() {
  document.body.dataset.control = control();
}

// --- an encounter

// Fetch an encounter of the choices and show its street; returns whether it is there.
async function prepare() {
  const run = ++game.run;
  enter("loading", "Building the street …", "the first time with an opponent takes some seconds");
  try {
    const asked = {opponent: $("opponent").value, street: $("street").value, control: control()};
    const shown = await insist("encounters", asked);
    if (run !== game.run) return false;
    take(shown);
    game.asked = JSON.stringify(asked);
    return true;
  } catch (error) {
    if (run === game.run) enter("menu", "That did not work", error.message);
    return false;
  }
}

async function preview() {
  if (await prepare()) enter("menu", "Two cars, one gap", game.shown.has_second_person ? INVITATION_OF_TWO : INVITATION);
}

async function begin() {
  const asked = JSON.stringify({opponent: $("opponent").value, street: $("street").value, control: control()});
  const is_there = game.phase === "menu" && game.asked === asked && game.frames.length === 1;
  if (is_there || await prepare()) ready();
}

function take(shown) {
  game.at_s = 0;
  game.shown = shown;
  game.frames = shown.frames;
  game.result = shown.result ?? null;
  game.waiting = false;
  held.clear();
  const is_for_two = shown.has_second_person;
  document.body.classList.toggle("two", is_for_two);
  $("own-name").textContent = is_for_two ? "dark" : "you";
  $("other-name").textContent = is_for_two ? "teal" : labelOf(game.menu.opponents, shown.opponent).split(":")[0].split(",")[0];
  nameKeys();
  view.show(shown, game.menu.colors);
  makeBars();
  SEATS.forEach(makeHorizons);
}

function ready() {
  sessionStorage.setItem(KEPT, game.shown.id);
  game.asked = null;
  game.at_s = 0;
  game.starts_at = performance.now() + 1000 * COUNTS * COUNT_S;
  const is_for_two = game.shown.has_second_person;
  const how = game.shown.control === "pedals" ? "hold go to drive, let go to roll out, hold brake to stop"
    : "choose how far ahead you look: a short horizon pushes, a long one gives way";
  enter("ready", is_for_two ? "Dark car against teal car" : "You are the dark car", how);
  $("start").blur();
  $("view").focus({preventScroll: true});
  pressed();
}

function resume() {
  game.at_s = (game.frames.length - 1) * game.shown.dt_s;
  game.starts_at = performance.now() + 1000 * COUNTS * COUNT_S;
  enter("ready", "Here you go on", "");
}

function giveUp() {
  ++game.run;
  sessionStorage.removeItem(KEPT);
  game.frames = [];
  preview();
}

async function step() {
  const {run} = game, asked_at = performance.now(), n = game.frames.length - 1;
  game.waiting = true;
  try {
    const commands = {command: command("person"), opponent_command: game.shown.has_second_person ? command("opponent") : null};
    const frame = await insist(`encounters/${game.shown.id}/step`, {step: n, ...commands});
    if (run !== game.run) return;
    const took_s = (performance.now() - asked_at) / 1000;
    const {dt_s} = game.shown;
    game.lead_s = Math.min(dt_s, Math.max(0.97 * game.lead_s, took_s + 0.03));
    game.rate += 0.2 * (Math.min(1, dt_s / (took_s + 0.01)) - game.rate);
    game.frames.push(frame);
    if (frame.result) game.result = frame.result;
  } catch (error) {
    if (run !== game.run) return;
    sessionStorage.removeItem(KEPT);
    const gone = error.status === 404;
    enter("menu", gone ? "The encounter is lost" : "That did not work",
      gone ? "the server was started anew meanwhile; drive another one" : error.message);
  } finally {
    if (run === game.run) game.waiting = false;
  }
}

function over() {
  sessionStorage.removeItem(KEPT);
  const last = game.frames.at(-1), {result} = game, row = result?.row;
  const [own, other] = game.shown.has_second_person ? ["the dark car", "the teal car"] : ["you", "the opponent"];
  const first = {social: `${own} went first`, ego: `${other} went first`}[row?.passes_first];
  const time = row?.social_time_s != null && !game.shown.has_second_person ? `${row.social_time_s.toFixed(1)} s` : `${last.time_s.toFixed(1)} s`;
  const what = {success: first ? `Passed: ${first}` : "Passed", collision: "Crash", deadlock: "Stuck, nose to nose",
    timeout: "Out of time", social_collision: "Crash"}[last.outcome];
  const gap = row && last.outcome === "success" ? `, smallest gap ${row.smallest_gap_m.toFixed(1)} m` : "";
  enter("over", what, `${time}${gap}`);
  $("file").textContent = result?.error ?? (result ? `recorded: ${result.file}` : "");
  if (result) tell(result.results?.length ? result.results : game.menu.results);
  $("scrubber").max = last.time_s;
  game.playing = false;
  scrub(last.time_s);
  $("again").focus({preventScroll: true});
}

// --- what the opponent thinks

function bar(name, color) {
  const row = document.createElement("div");
  row.className = "bar";
  row.dataset.horizon = name;
  row.innerHTML = '<span class="name"></span><span class="track"><span class="fill"></span></span><span class="share"></span>';
  row.querySelector(".fill").style.display = "block";
  row.style.setProperty("--own", color);
  row.querySelector(".name").textContent = name === "inf" ? "gives way" : `${name} s`;
  return row;
}

function makeBars() {
  $("bars").replaceChildren(...game.shown.horizons.map(name => bar(name, game.shown.horizon_colors[name])));
}

function think(frame) {
  const {shown} = game;
  [...$("bars").children].forEach((row, i) => {
    const is_chosen = row.dataset.horizon === frame.horizon;
    const share = frame.probability.length ? frame.probability[i] : Number(is_chosen);
    row.classList.toggle("chosen", is_chosen);
    row.querySelector(".fill").style.transform = `scaleX(${share.toFixed(3)})`;
    row.querySelector(".share").textContent = frame.probability.length ? `${Math.round(100 * share)} %` : "";
  });
  $("thought").textContent = thought(frame, shown);
}

function thought(frame, shown) {
  if (frame.intervention !== "none") return `The safety layer drives: ${frame.intervention.replace("_", " ")}`;
  if (frame.is_full_braking) return "It finds no way and brakes as hard as it can.";
  if (frame.step === 0) return "Five times a second it chooses how far ahead it predicts you: the ribbon before your car. The thin line is its plan.";
  if (frame.horizon === null) return "It drives by a rule, without a prediction horizon.";
  if (frame.horizon === "inf") return "It gives way to you.";
  if (frame.horizon === "0") return "It does not predict you at all: it pushes through.";
  return `It avoids where you will be within ${frame.horizon} s at your present speed: the ribbon before your car.`;
}

// --- drawing

function moment(at_s) {
  const {frames, shown} = game, last = frames.length - 1;
  const index = Math.min(last, Math.max(0, Math.floor(at_s / shown.dt_s + 1e-6)));
  const frame = frames[index], next = frames[Math.min(last, index + 1)];
  const share = Math.min(1, Math.max(0, at_s / shown.dt_s - index));
  const vehicles = index === last ? frame.vehicles : between(frame.vehicles, next.vehicles, share, shown.dt_s);
  const shown_frame = index === last ? frame : next;
  return {vehicles, frame: shown_frame, horizon: shown_frame.horizon, plan: shown_frame.plan,
    outcome: index === last ? frame.outcome : null};
}

function show(at_s) {
  const now = moment(at_s), {person, opponent} = game.shown.vehicle;
  view.draw(now);
  const kmh = i => Math.max(0, Math.round(3.6 * Math.abs(now.vehicles[i][3])));
  $("clock").textContent = `${Math.max(0, at_s).toFixed(1)} s`;
  $("own-speed").textContent = kmh(person);
  $("other-speed").textContent = kmh(opponent);
  if (show.frame !== now.frame) think(now.frame);
  show.frame = now.frame;
}

let before = performance.now();
function tick(now) {
  const passed_s = Math.min(0.1, (now - before) / 1000);
  before = now;
  if (game.shown && game.frames.length && game.phase !== "loading") advance(now, passed_s);
  requestAnimationFrame(tick);
}

function advance(now, passed_s) {
  const {dt_s} = game.shown, last_s = (game.frames.length - 1) * dt_s;
  if (game.phase === "ready") {
    const left_s = (game.starts_at - now) / 1000;
    $("count").textContent = Math.ceil(left_s / COUNT_S) || "";
    if (left_s <= 0) enter("drive", "", $("hint").textContent);
  } else if (game.phase === "drive") {
    const is_over = game.frames.at(-1).outcome !== null;
    game.at_s += game.rate * passed_s;
    if (game.at_s > last_s) {
      if (game.waiting) ++measured.late;
      game.at_s = last_s;
      if (is_over) { show(last_s); over(); return; }
    }
    if (!is_over && !game.waiting && game.at_s >= last_s - game.lead_s) step();
  } else if (game.phase === "over" && game.playing) {
    scrub(Math.min(last_s, game.at_s + passed_s));
    if (game.at_s >= last_s) play(false);
  }
  show(game.at_s);
  measured.drawn.push(now);
  while (measured.drawn[0] < now - 2000) measured.drawn.shift();
}

// --- replay

function scrub(at_s) {
  game.at_s = at_s;
  $("scrubber").value = at_s;
  $("scrubbed").textContent = `${at_s.toFixed(1)} s`;
}

function play(is_playing) {
  if (is_playing && game.at_s >= game.frames.at(-1).time_s) scrub(0);
  game.playing = is_playing;
  $("play").textContent = is_playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", is_playing ? "Pause the replay" : "Play the replay");
}

// --- buttons

$("choices").addEventListener("submit", event => {
  event.preventDefault();
  if (["drive", "ready", "paused"].includes(game.phase)) giveUp(); else if (game.phase !== "loading") begin();
});
$("choices").addEventListener("change", () => { setControl(); tell(game.menu.results); preview(); });
$("again").addEventListener("click", begin);
$("continue").addEventListener("click", resume);
$("play").addEventListener("click", () => play(!game.playing));
$("scrubber").addEventListener("input", () => { play(false); scrub(Number($("scrubber").value)); });
view.onresize = () => { if (game.shown && game.frames.length) show(game.at_s); };

async function open() {
  enter("loading", "Who goes first?", "");
  game.menu = await insist("menu");
  fill($("opponent"), game.menu.opponents);
  fill($("street"), game.menu.streets);
  setControl();
  tell(game.menu.results);
  const kept = sessionStorage.getItem(KEPT);
  if (kept) {
    try {
      take(await insist(`encounters/${encodeURIComponent(kept)}`));
      $("opponent").value = game.shown.opponent;
      $("street").value = game.shown.street_name;
      document.querySelector(`input[value=${game.shown.control}]`).checked = true;
      setControl();
      show(game.at_s = game.frames.at(-1).time_s);
      if (game.frames.at(-1).outcome === null) enter("paused", "Your encounter waits", "");
      else over();
      return;
    } catch (error) {
      sessionStorage.removeItem(KEPT);
    }
  }
  await preview();
}

open();
requestAnimationFrame(tick);
