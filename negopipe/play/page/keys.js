// Keys and fingers: the pedals and horizons that are held or chosen, for one person or for two at one page.
"use strict";

const KEYS = {ArrowUp: "go", KeyW: "go", ArrowDown: "brake", KeyS: "brake", Space: "brake"};
const SECOND_KEYS = ["KeyW", "KeyS"];  // of these, those of a second person, where there is one
const SECOND_HORIZONS = ["KeyQ", "KeyW", "KeyE", "KeyR", "KeyT"];  // the same for horizons, in their order
const KEY_NAMES = {person: {go: "↑", brake: "↓ space"}, opponent: {go: "W", brake: "S"}};  // where there are two people
const ONLY_KEY_NAMES = {go: "↑ W", brake: "↓ S space"};
const SEATS = ["person", "opponent"];

const held = new Set();  // pedals that are held: seat:source:pedal

const seatOf = element => element.closest("[data-seat]").dataset.seat;

function command(seat) {
  if (game.shown.control === "horizon") return game.horizon[seat];
  const pedals = new Set([...held].map(each => each.split(":")).filter(([own]) => own === seat).map(each => each[2]));
  return pedals.has("brake") ? "brake" : pedals.has("go") ? "go" : "ease";
}

function nameKeys() {
  for (const each of document.querySelectorAll(".pedal")) {
    const names = game.shown.has_second_person ? KEY_NAMES[seatOf(each)] : ONLY_KEY_NAMES;
    each.querySelector("kbd").textContent = names[each.dataset.pedal];
  }
}

function pressed() {
  for (const each of document.querySelectorAll(".pedal")) {
    const is_held = [...held].some(by => by.startsWith(`${seatOf(each)}:`) && by.endsWith(`:${each.dataset.pedal}`));
    each.setAttribute("aria-pressed", String(is_held));
  }
  for (const each of document.querySelectorAll(".horizons button")) {
    each.setAttribute("aria-pressed", String(each.dataset.horizon === game.horizon[seatOf(each)]));
  }
}

function hold(source, is_held) {
  held[is_held ? "add" : "delete"](source);
  pressed();
}

function makeHorizons(seat) {
  const {horizons, horizon_colors: colors} = game.shown;
  if (!horizons.includes(game.horizon[seat])) game.horizon[seat] = horizons[Math.floor(horizons.length / 2)];
  document.querySelector(`.horizons[data-seat=${seat}]`).replaceChildren(...horizons.map((name, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.horizon = name;
    button.style.setProperty("--own", colors[name]);
    button.textContent = name === "inf" ? "give way" : `${name} s`;
    const key = seat === "person" ? horizonKey(name) : (SECOND_HORIZONS[i] ?? "").replace("Key", "");
    button.insertAdjacentHTML("beforeend", `<kbd>${key}</kbd>`);
    for (const event of ["pointerdown", "click"]) button.addEventListener(event, () => choose(seat, name));
    return button;
  }));
}

const horizonKey = name => name === "inf" ? "9" : name;

function choose(seat, horizon) {
  game.horizon[seat] = horizon;
  pressed();
}

// Choose the horizon whose key it is, if there is one.
function chooseBy(event) {
  const {horizons, has_second_person: is_for_two} = game.shown, second = SECOND_HORIZONS.indexOf(event.code);
  const own = horizons.find(name => horizonKey(name) === event.key);
  if (own) choose("person", own); else if (is_for_two && horizons[second]) choose("opponent", horizons[second]);
}

// The pedal of a key as it is held, seat:source:pedal; undefined for another key.
function pedalBy(code) {
  const seat = game.shown?.has_second_person && SECOND_KEYS.includes(code) ? "opponent" : "person";
  return KEYS[code] && `${seat}:${code}:${KEYS[code]}`;
}

const isDriving = () => game.phase === "drive" || game.phase === "ready";

addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (isDriving()) {
    const pedal = pedalBy(event.code);
    if (game.shown.control === "pedals" && pedal) {
      event.preventDefault();  // no page that scrolls, no button that is pressed
      hold(pedal, true);
    } else if (game.shown.control === "horizon") chooseBy(event);
  } else if (game.phase === "over" && event.code === "Space" && event.target.tagName !== "BUTTON") {
    event.preventDefault();
    play(!game.playing);
  }
});
addEventListener("keyup", event => { const pedal = pedalBy(event.code); if (pedal) hold(pedal, false); });
addEventListener("blur", () => { held.clear(); pressed(); });
document.addEventListener("visibilitychange", () => { if (document.hidden) { held.clear(); pressed(); } });

for (const each of document.querySelectorAll(".pedal")) {
  const by = event => `${seatOf(each)}:touch${event.pointerId}:${each.dataset.pedal}`;
  each.addEventListener("pointerdown", event => { each.setPointerCapture(event.pointerId); hold(by(event), true); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    each.addEventListener(end, event => hold(by(event), false));
  }
  each.addEventListener("contextmenu", event => event.preventDefault());  // a long touch is a held pedal
}
