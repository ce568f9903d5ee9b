"use strict";
// Shows the pictures that the monitor sends (fleetloc/monitor/views.py). All text goes in as text, never as markup.

const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b08900", "#3fa7d6", "#7b5ea7", "#8c564b"];
const SILENCE_MS = 2500;  // without an event for longer, the page says so: it must not look alive when it is not
const EDGE_PX = 70;
const MIN_SPAN_M = 12;

const byId = (id) => document.getElementById(id);
const tracks = new Map();
let picture = null;
let lastEventMs = 0;
let trackLimits = { spacing_s: 0.2, track_s: 60 };
let view = null;  // {east, north, scale} of the map's middle, px per m; set by hand once the user moved it
let byHand = false;

// --- building blocks ----------------------------------------------------------------------------------------------

function svg(parent, name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  parent.appendChild(node);
  return node;
}

function cell(row, text, kind) {
  const node = document.createElement("td");
  node.textContent = text;
  if (kind) node.className = kind;
  row.appendChild(node);
  return node;
}

const known = (value) => value !== null && value !== undefined;
const number = (value, digits, scale = 1) => (known(value) ? (value * scale).toFixed(digits) : "–");
const short = (value) => number(value, value < 10 ? 2 : value < 100 ? 1 : 0);
const clock = (unixS) => new Date(unixS * 1000).toISOString().slice(11, 19);
const isGone = (drone) => drone.status === "lost" || drone.status === "stale";

function colourOf(id) {
  const ids = picture.drones.map((drone) => drone.agent_id);
  return COLOURS[ids.indexOf(id) % COLOURS.length];
}

function niceStep(span) {
  const power = 10 ** Math.floor(Math.log10(span));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => span / step <= 1) ?? 10 * power;
}

// --- the words ----------------------------------------------------------------------------------------------------

function showWords() {
  byId("fleet").textContent = picture.fleet;
  byId("clock").textContent = `${clock(picture.unix_s)} UTC`;
  document.title = `${picture.fleet}: fleetloc monitor`;
  const shown = picture.alarms.filter((alarm) => alarm.level === "bad" || alarm.level === "warning");
  const worst = picture.alarms.length ? picture.alarms[0].level : "ok";
  const overall = byId("overall");
  overall.className = `badge ${worst}`;
  overall.textContent = shown.length ? (shown.length === 1 ? "1 alarm" : `${shown.length} alarms`) : worst === "ok" ? "all well" : "starting";
  byId("alarm-count").textContent = shown.length ? `(${shown.length})` : "";
  showAlarms();
  showDrones();
  showTargets();
  showLinks();
  const refused = Object.entries(picture.refused).map(([reason, count]) => `${reason} ${count}`);
  byId("refused").textContent = refused.length ? `Packets that this monitor refused: ${refused.join(", ")}` : "";
}

function showAlarms() {
  const items = picture.alarms.map((alarm) => {
    const item = document.createElement("li");
    item.className = alarm.level;
    item.dataset.drone = alarm.agent_id;
    const since = document.createElement("time");
    since.textContent = `since ${clock(alarm.since_unix_s)}`;
    const who = document.createElement("b");
    who.textContent = alarm.agent_id ? `drone ${alarm.agent_id}` : picture.fleet;
    item.append(since, who, alarm.text);
    return item;
  });
  if (!items.length) {
    const none = document.createElement("li");
    none.className = "ok";
    none.textContent = "none";
    items.push(none);
  }
  byId("alarms").replaceChildren(...items);
}

function showDrones() {
  const rows = picture.drones.map((drone) => {
    const row = document.createElement("tr");
    row.dataset.drone = drone.agent_id;
    row.dataset.status = drone.status;
    const who = cell(row, "");
    const swatch = document.createElement("span");
    swatch.className = "swatch";
    swatch.style.background = colourOf(drone.agent_id);
    who.append(swatch, `${drone.agent_id} ${drone.name}`.trim());
    cell(row, drone.status, `text ${drone.level}`);
    const place = drone.position_m;
    cell(row, place ? number(place[0], 1) : "–");
    cell(row, place ? number(place[1], 1) : "–");
    cell(row, place ? number(-place[2], 1) : "–");
    cell(row, drone.ellipse ? `${short(drone.ellipse.major_m)} / ${short(drone.ellipse.up_m)}` : "–");
    cell(row, drone.protection_m ? `${short(drone.protection_m[0])} / ${short(drone.protection_m[1])}` : "–");
    cell(row, number(drone.estimate_age_s, 1), isGone(drone) ? drone.level : "");
    cell(row, known(drone.gps_age_s) ? `${drone.gps} ${short(drone.gps_age_s)} s` : drone.gps || "–",
      known(drone.gps_age_s) && drone.gps_age_s > 3 ? "warning" : "");
    cell(row, number(drone.tick_p99_s, 1, 1000));
    return row;
  });
  byId("drones").tBodies[0].replaceChildren(...rows);
}

function showTargets() {
  byId("targets-part").hidden = !picture.targets.length;
  const rows = picture.targets.map((target) => {
    const row = document.createElement("tr");
    row.dataset.target = target.target_id;
    cell(row, `${target.target_id} ${target.name}`.trim());
    const place = target.seen_by ? target.seen_by.position_m : null, speed = target.velocity_mps;
    cell(row, place ? number(place[0], 1) : "–");
    cell(row, place ? number(place[1], 1) : "–");
    cell(row, place ? number(-place[2], 1) : "–");
    cell(row, target.ellipse ? `${short(target.ellipse.major_m)} / ${short(target.ellipse.up_m)}` : "–");
    cell(row, speed ? number(Math.hypot(speed[0], speed[1]), 1) : "–");
    cell(row, target.seen_by ? number(target.seen_by.age_s, 1) : "–");
    cell(row, target.seen_by ? target.seen_by.agent_id : "nobody");
    cell(row, target.state || "–", !target.state || target.state === "known" ? "" : "warning");
    return row;
  });
  byId("targets").tBodies[0].replaceChildren(...rows);
}

function showLinks() {
  const rows = picture.links.map((link) => {
    const row = document.createElement("tr");
    row.dataset.link = `${link.sender}-${link.receiver}`;
    cell(row, `${link.sender} → ${link.receiver}`);
    cell(row, number(link.age_s, 1), link.level === "bad" ? "bad" : "");
    cell(row, known(link.loss) ? `${number(link.loss, 0, 100)} %` : "–", link.level === "warning" ? "warning" : "");
    cell(row, link.rejected, link.rejected ? "warning" : "");
    cell(row, number(link.round_trip_s, 1, 1000));
    cell(row, number(link.clock_offset_s, 1, 1000));
    return row;
  });
  byId("links").tBodies[0].replaceChildren(...rows);
}

// --- the maps -----------------------------------------------------------------------------------------------------

function extent(points, reach) {
  const low = Math.min(...points.map((p, i) => p - reach[i]));
  const high = Math.max(...points.map((p, i) => p + reach[i]));
  return points.length ? [low, high] : [-MIN_SPAN_M / 2, MIN_SPAN_M / 2];
}

function placed() {
  return picture.drones.filter((drone) => drone.position_m);
}

function sighted() {
  return picture.targets.filter((target) => target.seen_by && target.ellipse);
}

function spots() {  // what the view has to hold: [north, east, reach]; uncertainties as far as they are not absurd
  const fixed = Object.values(picture.anchors).map(([north, east]) => [north, east, 0]);
  const aims = sighted().map((target) => [...target.seen_by.position_m.slice(0, 2), Math.min(target.ellipse.major_m, 30)]);
  return fixed.concat(aims, placed().flatMap((drone) => {
    const own = [...drone.position_m.slice(0, 2), Math.min(drone.ellipse ? drone.ellipse.major_m : 0, 30)];
    if (!isGone(drone) || !drone.seen_by) return [own];
    return [own, [...drone.seen_by.position_m.slice(0, 2), Math.min(3 * drone.seen_by.sigma_m, 5)]];
  }));
}

function fitted(width, height) {
  const all = spots(), reach = all.map((spot) => spot[2]);
  const [south, north] = extent(all.map((spot) => spot[0]), reach);
  const [west, east] = extent(all.map((spot) => spot[1]), reach);
  const scale = Math.min((width - 2 * EDGE_PX) / Math.max(east - west, MIN_SPAN_M),
    (height - 2 * EDGE_PX) / Math.max(north - south, MIN_SPAN_M));
  return { east: (east + west) / 2, north: (north + south) / 2, scale: Math.max(scale, 1e-3) };
}

function follow(width, height) {
  const wanted = fitted(width, height);
  if (!view) view = wanted;
  if (byHand) return;
  // growing at once, else everything would leave the map; shrinking and moving slowly, so that eyes can follow
  const zoom = wanted.scale < view.scale ? 1 : 0.05;
  view.scale += zoom * (wanted.scale - view.scale);
  view.east += 0.15 * (wanted.east - view.east);
  view.north += 0.15 * (wanted.north - view.north);
}

function drawTop() {
  const map = byId("top");
  const { width, height } = map.getBoundingClientRect();
  if (!width || !height) return;
  follow(width, height);
  const x = (east) => width / 2 + (east - view.east) * view.scale;
  const y = (north) => height / 2 - (north - view.north) * view.scale;
  const layer = document.createElementNS("http://www.w3.org/2000/svg", "g");
  grid(layer, width, height);
  const colours = new Map(picture.drones.map((drone) => [drone.agent_id, colourOf(drone.agent_id)]));
  for (const [id, { points }] of tracks) {
    if (points.length < 2 || !colours.has(id)) continue;
    const path = points.map(([n, e]) => `${x(e).toFixed(1)},${y(n).toFixed(1)}`).join(" ");
    svg(layer, "polyline", { class: "track", points: path, stroke: colours.get(id) });
  }
  links(layer, x, y);
  for (const [id, [north, east]] of Object.entries(picture.anchors)) {
    const at = { x: x(east), y: y(north) };
    svg(layer, "path", { class: "anchor", d: `M ${at.x} ${at.y - 7} l 7 12 l -14 0 Z`, fill: "currentColor" });
    svg(layer, "text", { class: "label", x: at.x + 10, y: at.y + 5 }, id);
  }
  for (const target of sighted()) targetFromAbove(layer, target, x, y);
  for (const drone of placed()) fromAbove(layer, drone, colours.get(drone.agent_id), x, y);
  map.replaceChildren(layer);
}

function grid(layer, width, height) {
  const step = niceStep(90 / view.scale);
  const west = view.east - width / 2 / view.scale, south = view.north - height / 2 / view.scale;
  for (let e = Math.ceil(west / step) * step; e < west + width / view.scale; e += step) {
    const at = (e - west) * view.scale;
    svg(layer, "line", { class: Math.abs(e) < step / 2 ? "zero" : "grid", x1: at, x2: at, y1: 0, y2: height });
    svg(layer, "text", { class: "axis", x: at + 3, y: height - 4 }, `${+e.toFixed(3)}`);
  }
  for (let n = Math.ceil(south / step) * step; n < south + height / view.scale; n += step) {
    const at = height - (n - south) * view.scale;
    svg(layer, "line", { class: Math.abs(n) < step / 2 ? "zero" : "grid", x1: 0, x2: width, y1: at, y2: at });
    svg(layer, "text", { class: "axis", x: 3, y: at - 3 }, `${+n.toFixed(3)}`);
  }
  const long = step * view.scale;
  svg(layer, "line", { class: "scale", x1: width - 20 - long, x2: width - 20, y1: 18, y2: 18 });
  svg(layer, "text", { x: width - 20, y: 38, "text-anchor": "end" }, `${+step.toFixed(3)} m`);
  svg(layer, "path", { class: "scale", d: "M 24 44 L 24 14 M 17 24 L 24 12 L 31 24", fill: "none" });
  svg(layer, "text", { x: 36, y: 26, class: "label" }, "N");
}

function links(layer, x, y) {
  const place = new Map(placed().map((drone) => [drone.agent_id, drone.position_m]));
  const order = ["info", "ok", "warning", "bad"];
  const pairs = new Map();
  for (const link of picture.links) {  // of the two directions the worse is drawn
    const key = [link.sender, link.receiver].sort((a, b) => a - b).join("-");
    const other = pairs.get(key);
    if (!other || order.indexOf(link.level) > order.indexOf(other.level)) pairs.set(key, link);
  }
  for (const link of pairs.values()) {
    const a = place.get(link.sender), b = place.get(link.receiver);
    if (!a || !b) continue;
    svg(layer, "line", { class: `link ${link.level}`, x1: x(a[1]), y1: y(a[0]), x2: x(b[1]), y2: y(b[0]) });
    const words = [];
    if (known(link.loss) && link.loss >= 0.05) words.push(`${(100 * link.loss).toFixed(0)} %`);
    if (known(link.age_s) && link.age_s > 1.5) words.push(`${link.age_s.toFixed(0)} s`);
    if (words.length) {
      const middle = { x: x((a[1] + b[1]) / 2), y: y((a[0] + b[0]) / 2), "text-anchor": "middle" };
      svg(layer, "text", { class: "link-label", ...middle }, words.join(", "));
    }
  }
}

function fromAbove(layer, drone, colour, x, y) {
  const group = svg(layer, "g", { class: isGone(drone) ? "drone gone" : "drone", "data-drone": drone.agent_id });
  const [north, east] = drone.position_m;
  const at = { x: x(east), y: y(north) };
  if (drone.ellipse) {
    const { major_m, minor_m, angle_rad } = drone.ellipse;
    const covers = major_m * view.scale > byId("top").clientWidth;  // would only tint the whole map
    svg(group, "ellipse", { class: covers ? "ellipse vast" : "ellipse", cx: at.x, cy: at.y, rx: minor_m * view.scale, ry: major_m * view.scale,
      fill: colour, stroke: colour, transform: `rotate(${angle_rad * 180 / Math.PI} ${at.x} ${at.y})` });
  }
  if (drone.velocity_mps && !isGone(drone)) {
    const [vn, ve] = drone.velocity_mps;
    svg(group, "line", { class: "speed", stroke: colour, x1: at.x, y1: at.y, x2: at.x + ve * view.scale, y2: at.y - vn * view.scale });
  }
  if (drone.seen_by && isGone(drone)) {
    const [n, e] = drone.seen_by.position_m;
    svg(group, "circle", { class: "seen", cx: x(e), cy: y(n), r: Math.max(3 * drone.seen_by.sigma_m * view.scale, 10), stroke: colour });
  }
  svg(group, "circle", { cx: at.x, cy: at.y, r: 7, fill: isGone(drone) ? "var(--back)" : colour, stroke: colour, "stroke-width": 3 });
  if (drone.status === "lost") {
    svg(group, "path", { class: "cross", d: `M ${at.x - 10} ${at.y - 10} l 20 20 m 0 -20 l -20 20` });
  }
  const words = drone.level === "ok" ? `${drone.agent_id}` : `${drone.agent_id} ${drone.status}`;
  svg(group, "text", { class: `label ${drone.level}`, x: at.x + 12, y: at.y - 12 }, words);
}

function targetFromAbove(layer, target, x, y) {
  const group = svg(layer, "g", { class: "target", "data-target": target.target_id });
  const [north, east] = target.seen_by.position_m, { major_m, minor_m, angle_rad } = target.ellipse;
  const at = { x: x(east), y: y(north) }, vast = major_m * view.scale > byId("top").clientWidth;
  svg(group, "ellipse", { class: vast ? "ellipse vast" : "ellipse", cx: at.x, cy: at.y, rx: minor_m * view.scale, ry: major_m * view.scale,
    fill: "currentColor", stroke: "currentColor", transform: `rotate(${angle_rad * 180 / Math.PI} ${at.x} ${at.y})` });
  const [vn, ve] = target.velocity_mps;
  svg(group, "line", { class: "speed", stroke: "currentColor", x1: at.x, y1: at.y, x2: at.x + ve * view.scale, y2: at.y - vn * view.scale });
  svg(group, "path", { d: `M ${at.x - 7} ${at.y} l 7 -7 l 7 7 l -7 7 Z`, fill: "currentColor" });
  svg(group, "text", { class: "label", x: at.x + 12, y: at.y - 8 }, `${target.target_id} ${target.name}`.trim());
}

function drawSide() {
  const map = byId("side");
  const { width, height } = map.getBoundingClientRect();
  if (!width || !height || !view) return;
  const drones = placed(), aims = sighted();
  const ups = [...drones.map((d) => -d.position_m[2]), ...aims.map((t) => -t.seen_by.position_m[2])];
  const reach = [...drones, ...aims].map((body) => Math.min(body.ellipse ? body.ellipse.up_m : 0, 30));
  const [low, high] = extent(ups, reach);
  const bottom = Math.min(low, 0), span = Math.max(high - bottom, 5) * 1.15;
  const top = Math.max(high, bottom + 5) + 0.07 * span;
  const x = (east) => width / 2 + (east - view.east) * view.scale;
  const y = (up) => 16 + (top - up) / (top - bottom) * (height - 26);
  const layer = document.createElementNS("http://www.w3.org/2000/svg", "g");
  const step = niceStep(span / 4);
  for (let up = Math.ceil(bottom / step) * step; up <= top; up += step) {
    svg(layer, "line", { class: Math.abs(up) < step / 2 ? "zero" : "grid", x1: 0, x2: width, y1: y(up), y2: y(up) });
    svg(layer, "text", { class: "axis", x: 3, y: y(up) - 3 }, `${+up.toFixed(3)} m`);
  }
  for (const target of aims) {
    const at = { x: x(target.seen_by.position_m[1]), y: y(-target.seen_by.position_m[2]) };
    const half = target.ellipse.up_m * (height - 26) / (top - bottom);
    svg(layer, "line", { x1: at.x, x2: at.x, y1: at.y - half, y2: at.y + half, stroke: "currentColor", "stroke-width": 4, opacity: 0.5 });
    svg(layer, "path", { d: `M ${at.x - 6} ${at.y} l 6 -6 l 6 6 l -6 6 Z`, fill: "currentColor" });
    svg(layer, "text", { class: "label", x: at.x + 10, y: at.y - 7 }, `${target.target_id}`);
  }
  for (const drone of drones) {
    const colour = colourOf(drone.agent_id), at = { x: x(drone.position_m[1]), y: y(-drone.position_m[2]) };
    const group = svg(layer, "g", { class: isGone(drone) ? "gone" : "" });
    if (drone.ellipse) {
      const half = drone.ellipse.up_m * (height - 26) / (top - bottom);
      svg(group, "line", { x1: at.x, x2: at.x, y1: at.y - half, y2: at.y + half, stroke: colour, "stroke-width": 4, opacity: 0.5 });
    }
    svg(group, "circle", { cx: at.x, cy: at.y, r: 6, fill: isGone(drone) ? "var(--back)" : colour, stroke: colour, "stroke-width": 3 });
    svg(group, "text", { class: `label ${drone.level}`, x: at.x + 10, y: at.y - 7 }, `${drone.agent_id}`);
  }
  map.replaceChildren(layer);
}

function draw() {
  if (!picture) return;
  drawTop();
  drawSide();
}

// --- what the user does -------------------------------------------------------------------------------------------

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  byId("theme").textContent = name === "dark" ? "light" : "dark";
}

function chooseTheme() {  // what was chosen is kept; until then the page follows the system
  const name = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  setTheme(name);
  localStorage.setItem("theme", name);
}

function fit() {
  byHand = false;
  view = null;
  draw();
}

byId("theme").onclick = chooseTheme;
byId("fit").onclick = fit;
setTheme(localStorage.getItem("theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
const top_ = byId("top");
top_.ondblclick = fit;
top_.onwheel = (event) => {
  event.preventDefault();
  if (!view) return;
  const { left, top, width, height } = top_.getBoundingClientRect();
  const dx = event.clientX - left - width / 2, dy = event.clientY - top - height / 2;
  const factor = Math.exp(-event.deltaY * 0.0015);
  view.east += dx / view.scale * (1 - 1 / factor);
  view.north -= dy / view.scale * (1 - 1 / factor);
  view.scale *= factor;
  byHand = true;
  draw();
};
top_.onpointerdown = (event) => top_.setPointerCapture(event.pointerId);
top_.onpointermove = (event) => {
  if (!view || !(event.buttons & 1)) return;
  view.east -= event.movementX / view.scale;
  view.north += event.movementY / view.scale;
  byHand = true;
  draw();
};
addEventListener("resize", draw);

// --- what comes in ------------------------------------------------------------------------------------------------

function onPicture(event) {
  picture = JSON.parse(event.data);
  lastEventMs = performance.now();
  for (const drone of picture.drones) extendTrack(drone);
  showWords();
  draw();
}

function extendTrack(drone) {
  const now = picture.unix_s, track = tracks.get(drone.agent_id) ?? { points: [], last_s: -Infinity };
  if (!drone.position_m || isGone(drone) || Math.abs(now - track.last_s) < trackLimits.spacing_s * 0.9) return;
  track.last_s = now;
  track.points.push(drone.position_m);
  while (track.points.length > trackLimits.track_s / trackLimits.spacing_s) track.points.shift();
  tracks.set(drone.agent_id, track);
}

function onTracks(event) {
  lastEventMs = performance.now();
  const { track_s, spacing_s, points } = JSON.parse(event.data);
  trackLimits = { track_s, spacing_s };
  tracks.clear();
  for (const [id, past] of Object.entries(points)) tracks.set(Number(id), { points: past, last_s: -Infinity });
}

function watchFeed() {
  const silent = performance.now() - lastEventMs > SILENCE_MS;
  byId("feed").hidden = !silent;
  document.body.classList.toggle("deaf", silent);
}

const events = new EventSource("/events");
events.addEventListener("picture", onPicture);
events.addEventListener("tracks", onTracks);
setInterval(watchFeed, 500);
