// Drawing of an encounter: the street, both cars and the prediction ribbon, in the colours of the report's films.
"use strict";

// Height of the canvas that is left free for what lies over it, px: readings above, headlines below.
const FREE_TOP_PX = 44, FREE_BOTTOM_PX = 16;
const MOST_PX_PER_M = 24;
// Half of the width of road that is shown at least, m; on a tall canvas the length of street that is shown at least, and
// that beyond the outer car.
const HALF_ROAD_M = 4, NEAREST_VIEW_M = 30, BESIDE_M = 8;
const SEATS_ON_STREET = ["person", "opponent"];

class StreetView {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.shown = null;
    this.picture = null;
    new ResizeObserver(() => { this.picture = null; this.onresize?.(); }).observe(canvas);
  }

  // shown: scenery of an encounter (negopipe/play/scenery.py); colors: of the menu
  show(shown, colors) {
    this.shown = shown;
    this.colors = colors;
    this.picture = this.glided = null;
  }

  get isTall() {
    const {width, height} = this.canvas.getBoundingClientRect();
    return height > width;
  }

  // The part of the street that is shown: all between starts and targets; on a tall canvas that one person looks at, from
  // the person to the opponent.
  range(vehicles) {
    const {reach_m: reach, person_way: way, vehicle} = this.shown;
    if (!this.isTall || this.shown.has_second_person) return [-reach, reach];
    const [own, other] = [vehicle.person, vehicle.opponent].map(i => way * this.sigmaOf(...vehicles[i]));
    const ahead = other > own ? Math.max(NEAREST_VIEW_M, other - own + BESIDE_M) : NEAREST_VIEW_M;
    const end = Math.min(own + ahead, reach), wanted = [Math.min(own - BESIDE_M, end - NEAREST_VIEW_M), end];
    const old = this.glided ?? wanted, glide = Math.abs(old[0] - wanted[0]) > 20 ? 1 : 0.12;
    this.glided = wanted.map((value, i) => old[i] + glide * (value - old[i]));
    return this.glided.map(value => way * value).sort((a, b) => a - b);
  }

  // The person drives from left to right, on a tall canvas upwards.
  fit([from, to]) {
    const {width, height} = this.canvas.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio || 1, 2), size = [width, height].map(x => Math.max(1, Math.round(x * ratio)));
    if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size;
    const middle = this.placeAt(0).heading + (this.shown.person_way < 0 ? Math.PI : 0);
    const turn = (height > width ? Math.PI / 2 : 0) - middle;
    this.cos = Math.cos(turn);
    this.sin = Math.sin(turn);
    const n = 24, corners = [];
    for (let i = 0; i <= n; i++) {
      const {x, y, heading} = this.placeAt(from + (to - from) * i / n);
      for (const d of [-HALF_ROAD_M, HALF_ROAD_M]) corners.push(this.turned(x - d * Math.sin(heading), y + d * Math.cos(heading)));
    }
    const [us, vs] = [0, 1].map(axis => corners.map(corner => corner[axis]));
    const box = {left: Math.min(...us), right: Math.max(...us), low: Math.min(...vs), high: Math.max(...vs)};
    const free = {width: width - 8, height: height - FREE_TOP_PX - FREE_BOTTOM_PX};
    const scale = Math.min(free.width / (box.right - box.left), free.height / (box.high - box.low), MOST_PX_PER_M);
    this.ratio = ratio;
    this.scale = Math.max(0.5, scale) * ratio;
    this.left = (width * ratio - this.scale * (box.left + box.right)) / 2;
    this.top = (FREE_TOP_PX + free.height / 2) * ratio + this.scale * (box.low + box.high) / 2;
  }

  turned(x, y) { return [this.cos * x - this.sin * y, this.sin * x + this.cos * y]; }

  // world (m) -> canvas (px)
  at(x, y) {
    const [u, v] = this.turned(x, y);
    return [this.left + this.scale * u, this.top - this.scale * v];
  }

  path(points) {
    this.pen.beginPath();
    points.forEach((point, i) => this.pen[i ? "lineTo" : "moveTo"](...this.at(...point)));
  }

  area(points, color) {
    this.path(points);
    this.pen.closePath();
    this.pen.fillStyle = color;
    this.pen.fill();
  }

  // Place and heading on the reference line at sigma, and the offset of a route there (way: +1 along the line, -1 against it).
  placeAt(sigma, way = 1) {
    const {line, route_d: routes} = this.shown.street;
    let low = 0, high = line.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (line[middle][0] <= sigma) low = middle; else high = middle;
    }
    const share = Math.min(1, Math.max(0, (sigma - line[low][0]) / (line[high][0] - line[low][0] || 1)));
    const mix = (a, b) => a + share * (b - a);
    const route = routes[way > 0 ? 0 : 1];
    const [x, y, heading] = [1, 2, 3].map(i => mix(line[low][i], line[high][i]));
    return {x, y, heading, d: mix(route[low], route[high])};
  }

  sigmaOf(x, y) {
    let best = Infinity, found = null;
    for (const each of this.shown.street.line) {
      const far = (each[1] - x) ** 2 + (each[2] - y) ** 2;
      if (far < best) { best = far; found = each; }
    }
    return found[0] + (x - found[1]) * Math.cos(found[3]) + (y - found[2]) * Math.sin(found[3]);
  }

  box(x, y, yaw, from, to, width) {
    const cos = Math.cos(yaw), sin = Math.sin(yaw), half = width / 2;
    return [[from, -half], [to, -half], [to, half], [from, half]].map(([a, b]) => [x + a * cos - b * sin, y + a * sin + b * cos]);
  }

  // All that does not move; where the view does not move either, it is drawn once per size of the canvas.
  drawStreet(vehicles) {
    this.fit(this.range(vehicles));
    const {street} = this.shown, {pen, colors} = this;
    pen.fillStyle = colors.ground;
    pen.fillRect(0, 0, this.canvas.width, this.canvas.height);
    const between = ([right, left]) => [...right, ...[...left].reverse()];
    this.area(between(street.kerbs), colors.road);
    street.corridors.forEach(each => this.area(between(each), colors.corridor));
    pen.lineWidth = 1.4 * this.ratio;
    pen.strokeStyle = colors.ink;
    street.kerbs.forEach(kerb => { this.path(kerb); pen.stroke(); });
    SEATS_ON_STREET.forEach(seat => this.drawTarget(seat));
    for (const [x, y, yaw, length, width] of street.parked) {
      this.car(x, y, yaw, length, width, colors.parked, "rgba(255,255,255,0.55)");
    }
    if (this.isTall) return;  // the view moves
    this.picture = document.createElement("canvas");
    this.picture.width = this.canvas.width;
    this.picture.height = this.canvas.height;
    this.picture.getContext("2d").drawImage(this.canvas, 0, 0);
  }

  // The line that a person has to reach; the opponent's is drawn where a second person drives it.
  drawTarget(seat) {
    const {line, kerbs} = this.shown.street, {pen} = this, is_for_two = this.shown.has_second_person;
    const index = line.findIndex(([sigma]) => sigma >= this.shown.target_sigma_m[seat]);
    if (index < 0 || (seat === "opponent" && !is_for_two)) return;
    this.path([kerbs[0][index], kerbs[1][index]]);
    pen.setLineDash([5 * this.ratio, 5 * this.ratio]);
    pen.lineWidth = 3 * this.ratio;
    pen.strokeStyle = is_for_two ? this.colors[seat] : this.colors.ink;
    pen.stroke();
    pen.setLineDash([]);
    const [x, y] = this.at(...kerbs[this.shown.person_way > 0 ? 0 : 1][index]), name = is_for_two ? this.nameOf(seat) : "your";
    if (this.isTall) this.word("target", x + 28 * this.ratio, y); else this.word(`${name} target`, x, y + 14 * this.ratio);
  }

  nameOf(seat) { return seat === "opponent" ? "teal" : this.shown.has_second_person ? "dark" : "you"; }

  // The name of who drives a car, beside it.
  drawName(seat, vehicles) {
    const i = this.shown.vehicle[seat], [px, py] = this.at(...vehicles[i]);
    const lift = (this.shown.size_m[i][1] / 2) * this.scale + 9 * this.ratio;
    if (this.isTall) this.word(this.nameOf(seat), px + lift + 8 * this.ratio, py); else this.word(this.nameOf(seat), px, py + lift);
  }

  // The way that the opponent plans, from its place on.
  drawPlan(plan, [x, y]) {
    const {pen} = this;
    this.path([[x, y], ...plan]);
    pen.globalAlpha = 0.55;
    pen.lineWidth = 2.2 * this.ratio;
    pen.lineJoin = pen.lineCap = "round";
    pen.strokeStyle = this.colors.opponent;
    pen.stroke();
    pen.globalAlpha = 1;
  }

  word(text, x, y) {
    const {pen} = this;
    pen.font = `${12 * this.ratio}px "DejaVu Sans", system-ui, sans-serif`;
    pen.fillStyle = this.colors.ink;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    const half = pen.measureText(text).width / 2 + 4 * this.ratio;
    pen.fillText(text, Math.min(this.canvas.width - half, Math.max(half, x)), y);
  }

  car(x, y, yaw, length, width, color, glass = "white") {
    const round = Math.min(0.45, width / 3);
    const {pen} = this;
    const [px, py] = this.at(x, y), s = this.scale;
    const [ux, uy] = this.turned(Math.cos(yaw), Math.sin(yaw));
    pen.save();
    pen.translate(px, py);
    pen.rotate(-Math.atan2(uy, ux));
    pen.fillStyle = color;
    pen.beginPath();
    pen.roundRect(-length / 2 * s, -width / 2 * s, length * s, width * s, round * s);
    pen.fill();
    pen.fillStyle = glass;
    pen.beginPath();
    pen.roundRect(0.14 * length * s, -0.4 * width * s, 0.16 * length * s, 0.8 * width * s, 0.15 * s);
    pen.fill();
    pen.restore();
  }

  // Outline of the next `metres` of the route of a car, as in the report's films.
  ribbon([x, y, yaw], metres, width) {
    const start = this.sigmaOf(x, y), ahead = this.placeAt(start).heading;
    const way = Math.cos(yaw - ahead) < 0 ? -1 : 1;
    const right = [], left = [], half = 0.4 * width, n = 24;
    for (let i = 0; i < n; i++) {
      const {x: a, y: b, heading, d} = this.placeAt(start + way * metres * i / (n - 1), way);
      right.push([a - (d - half) * Math.sin(heading), b + (d - half) * Math.cos(heading)]);
      left.unshift([a - (d + half) * Math.sin(heading), b + (d + half) * Math.cos(heading)]);
    }
    return [...right, ...left];
  }

  // moment: vehicles [[x, y, yaw, speed], ...] (m, rad, m/s), horizon (text or null), plan [[x, y], ...] (m) of the
  // opponent, outcome (text or null)
  draw(moment) {
    if (!this.shown) return;
    if (this.picture) this.pen.drawImage(this.picture, 0, 0); else this.drawStreet(moment.vehicles);
    const {pen, colors, shown} = this, {person, opponent} = shown.vehicle;
    const is_hidden = moment.horizon === null || moment.outcome || shown.has_second_person;  // two people see the same
    const horizon = is_hidden ? null : Number(moment.horizon === "inf" ? Infinity : moment.horizon);
    if (horizon) {
      pen.globalAlpha = 0.6;
      moment.vehicles.forEach((vehicle, i) => {
        if (i === opponent || !(vehicle[3] > 0.05)) return;
        const metres = vehicle[3] * Math.min(horizon, shown.plan_s);
        this.area(this.ribbon(vehicle, metres, shown.size_m[i][1]), shown.horizon_colors[moment.horizon] ?? colors.quiet);
      });
      pen.globalAlpha = 1;
    }
    if (moment.plan.length && !moment.outcome) this.drawPlan(moment.plan, moment.vehicles[opponent]);
    moment.vehicles.forEach(([x, y, yaw], i) => {
      this.car(x, y, yaw, ...shown.size_m[i], i === opponent ? colors.opponent : i === person ? colors.person : colors.quiet);
    });
    for (const seat of shown.has_second_person ? SEATS_ON_STREET : ["person"]) this.drawName(seat, moment.vehicles);
    if (moment.outcome === "collision") this.crash(moment.vehicles[person], moment.vehicles[opponent], shown);
  }

  crash(person, opponent, shown) {
    const {pen} = this, [x, y] = this.at((person[0] + opponent[0]) / 2, (person[1] + opponent[1]) / 2);
    const r = 11 * this.ratio;
    for (const [color, width] of [["white", 9], [this.colors.collision, 5]]) {
      pen.strokeStyle = color;
      pen.lineWidth = width * this.ratio;
      pen.lineCap = "round";
      pen.beginPath();
      pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r);
      pen.moveTo(x + r, y - r); pen.lineTo(x - r, y + r);
      pen.stroke();
    }
  }
}

// State of the vehicles between two frames, by the cubic of both places and velocities.
function between(a, b, share, dt) {
  return a.map(([x0, y0, yaw0, v0], i) => {
    const [x1, y1, yaw1, v1] = b[i], t = share;
    const h00 = (1 + 2 * t) * (1 - t) ** 2, h10 = t * (1 - t) ** 2, h01 = t * t * (3 - 2 * t), h11 = t * t * (t - 1);
    const mix = (p0, m0, p1, m1) => h00 * p0 + h10 * dt * m0 + h01 * p1 + h11 * dt * m1;
    const turn = Math.atan2(Math.sin(yaw1 - yaw0), Math.cos(yaw1 - yaw0));
    const x = mix(x0, v0 * Math.cos(yaw0), x1, v1 * Math.cos(yaw1)), y = mix(y0, v0 * Math.sin(yaw0), y1, v1 * Math.sin(yaw1));
    return [x, y, yaw0 + share * turn, v0 + share * (v1 - v0)];
  });
}
