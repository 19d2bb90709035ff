// The page at `/`: poses from /v1/poses, everything slower from /healthz. Drawn on animation frames, and only when
// something has changed; the subscription is dropped while the tab is hidden.

const RATE_HZ = 25;
const TRAIL_S = 12;
const TABLE_MS = 200; // digits that change faster cannot be read
const HEALTH_MS = 1000;
const STALE_S = 1;

// The mode in a word, and how good that is.
const MODES = {
  INIT: ["waiting", "fair", "No fix yet"],
  FULL: ["full", "good", "IMU and recent fixes"],
  COAST: ["coasting", "fair", "No fix for a while, the IMU alone"],
  DEGRADED: ["degraded", "bad", "Too uncertain to steer by"],
  INVALID: ["invalid", "bad", "Too uncertain to be good for anything"],
  NO_IMU: ["no IMU", "fair", "Fixes alone"],
  LOST: ["lost", "bad", "Neither fixes nor IMU data"],
};

const UNKNOWN = new Set(["INIT", "INVALID", "LOST"]);

const element = (id) => document.getElementById(id);
const seconds = () => performance.now() / 1000;

const robots = new Map(); // name -> {pose, place, received, trail, colour}; place: the last pose that means anything
let health = null;
let token = localStorage.getItem("steadfix-token") ?? "";
let locked = false;
let socket = null;
let retry = 0;
let pause = 0.5;
let dirty = true;

// The connection

function connect() {
  clearTimeout(retry);
  if (document.hidden || socket || locked) return;
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  const opened = new WebSocket(`${scheme}//${location.host}/v1/poses?rate=${RATE_HZ}`);
  socket = opened;
  opened.onopen = () => {
    pause = 0.5;
    if (token) opened.send(JSON.stringify({ type: "hello", token }));
    showState();
    fetchHealth();
  };
  opened.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.type === "pose") take(message);
  };
  opened.onclose = () => {
    if (socket !== opened) return; // dropped by ourselves
    socket = null;
    showState();
    retry = setTimeout(connect, pause * 1000);
    pause = Math.min(pause * 2, 5);
  };
}

function disconnect() {
  clearTimeout(retry);
  const dropped = socket;
  socket = null;
  dropped?.close();
}

document.addEventListener("visibilitychange", () => (document.hidden ? disconnect() : connect()));

// From another machine the service wants a token, and tells nothing until it has it.
function lock(open, text) {
  locked = true;
  disconnect();
  const form = element("locked");
  form.querySelector("label").hidden = form.querySelector("button").hidden = !open;
  const wrong = token ? "That is not the token." : "From another machine, this service wants its token.";
  setText(element("locked-text"), open ? wrong : text);
  form.hidden = false;
  showState();
}

element("locked").addEventListener("submit", (event) => {
  event.preventDefault();
  token = element("token").value;
  localStorage.setItem("steadfix-token", token);
  locked = false;
  element("locked").hidden = true;
  connect();
});

function take(pose) {
  const robot = robotNamed(pose.robot);
  const before = robot.pose;
  const trail = robot.trail;
  if (before && pose.t < before.t) trail.length = 0; // the service has started anew
  // Of a robot that is lost the filter only knows that it may be anywhere: it stays where it was last seen.
  if (!UNKNOWN.has(pose.mode)) {
    const gap = robot.place !== before || pose.reset_id !== before?.reset_id;
    trail.push({ t: pose.t, x: pose.position[0], y: pose.position[1], gap });
    robot.place = pose;
  }
  while (trail.length && trail[0].t < pose.t - TRAIL_S) trail.shift();
  robot.pose = pose;
  robot.received = seconds();
  dirty = true;
}

function robotNamed(name) {
  if (!robots.has(name)) robots.set(name, { pose: null, place: null, received: 0, trail: [], colour: robots.size % 6 });
  return robots.get(name);
}

async function fetchHealth() {
  if (document.hidden) return;
  try {
    const headers = token ? { Authorization: `Bearer ${token}` } : {};
    const answer = await fetch("/healthz", { cache: "no-store", headers, signal: AbortSignal.timeout(3000) });
    if (answer.status === 401 || answer.status === 403) {
      lock(answer.status === 401, await answer.text());
      return;
    }
    health = await answer.json();
    // In the order of the configuration, so that each robot keeps its colour.
    for (const name of Object.keys(health.robots)) robotNamed(name);
    dirty = true;
  } catch {
    // The socket tells of a lost connection.
  }
  showState();
}

// The words and numbers

function showState() {
  const connected = socket?.readyState === WebSocket.OPEN;
  const reasons = health?.reasons ?? [];
  let kind = "bad";
  let text = "No connection";
  if (connected && health) {
    kind = reasons.length ? "fair" : "good";
    const count = Object.keys(health.robots).length;
    text = reasons.length ? "Something is missing" : `${count} ${count === 1 ? "robot" : "robots"}, all well`;
  } else if (locked) {
    text = "Locked";
  } else if (!health) {
    kind = "";
    text = "Connecting";
  }
  element("state").className = kind;
  setText(element("state-text"), text);
  element("lost").hidden = connected || locked || !health;
  showList("trouble", connected ? reasons : []);
  const advice = Object.entries(health?.cameras ?? {}).flatMap(([name, camera]) =>
    camera.advice.map((text) => `camera ${name}: ${text}`),
  );
  showList("advice", connected ? advice : []);
}

function showList(section, texts) {
  element(section).hidden = texts.length === 0;
  const list = element(section).querySelector("ul");
  if (list.dataset.shown === texts.join("\n")) return;
  list.dataset.shown = texts.join("\n");
  list.replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

// Nothing is touched that stays the same: a selection survives, and the layout rests.
function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function setCell(cell, text, kind = "") {
  setText(cell, text);
  const name = cell.dataset.base + (kind ? ` ${kind}` : "");
  if (cell.className !== name) cell.className = name;
}

function rowFor(table, name, columns) {
  const body = element(table).tBodies[0];
  let row = [...body.rows].find((candidate) => candidate.dataset.name === name);
  if (!row) {
    row = body.insertRow();
    row.dataset.name = name;
    for (const base of columns) row.insertCell().dataset.base = base;
  }
  return row;
}

function showTables() {
  const now = seconds();
  for (const [name, robot] of robots) {
    const row = rowFor("robots", name, ["name", "mode", "number", "number", "number"]);
    const [label, mode, speed, age, sigma] = row.cells;
    row.style.setProperty("--colour", `var(--robot-${robot.colour})`);
    setCell(label, name);
    const pose = robot.pose;
    const silent = pose ? now - robot.received : Infinity;
    const [word, kind, meaning] = MODES[pose?.mode ?? health?.robots[name]?.mode ?? "INIT"] ?? [pose.mode, "fair", ""];
    row.className = silent > STALE_S ? "stale" : "";
    mode.title = meaning;
    setCell(mode, word, silent > STALE_S && pose ? "" : kind);
    setCell(speed, pose && !UNKNOWN.has(pose.mode) ? Math.hypot(pose.velocity[0], pose.velocity[1]).toFixed(2) : "–");
    const fixAge = pose?.fix_age == null ? null : pose.fix_age + silent;
    setCell(age, fixAge === null ? "–" : aged(fixAge), fixAge === null ? "" : fixAge < 1.5 ? "good" : fixAge < 5 ? "fair" : "bad");
    setCell(sigma, pose && !UNKNOWN.has(pose.mode) ? short(2000 * ellipse(pose.covariance).major) : "–");
  }
  for (const [name, camera] of Object.entries(health?.cameras ?? {})) {
    const row = rowFor("cameras", name, ["name", "", "number", "number"]);
    const [label, sees, rate, age] = row.cells;
    setCell(label, name);
    const count = camera.markers.length;
    setCell(sees, camera.status !== "ok" ? "nothing" : `${count} ${count === 1 ? "marker" : "markers"}`, count ? "" : "fair");
    setCell(rate, camera.frame_rate_hz.toFixed(1));
    setCell(age, camera.frame_age === null ? "–" : aged(camera.frame_age), camera.frame_age < 1 ? "" : "bad");
  }
  for (const table of ["robots", "cameras"]) {
    const empty = health !== null && element(table).tBodies[0].rows.length === 0;
    element(table).hidden = empty;
    element(table).nextElementSibling.hidden = !empty;
  }
}

const aged = (s) => (s < 99.95 ? s.toFixed(1) : s < 999 ? s.toFixed(0) : "999+");
const short = (mm) => (mm < 99.95 ? mm.toFixed(1) : mm < 9999 ? mm.toFixed(0) : "9999+");

// Semi-axes of one sigma (m) and the direction of the larger one, of a pose's covariance on the floor.
function ellipse(covariance) {
  const [a, b, d] = [covariance[0], covariance[1], covariance[7]];
  const middle = (a + d) / 2;
  const radius = Math.hypot((a - d) / 2, b);
  return {
    major: Math.sqrt(Math.max(middle + radius, 0)),
    minor: Math.sqrt(Math.max(middle - radius, 0)),
    angle: Math.atan2(2 * b, a - d) / 2,
  };
}

// The map

const canvas = element("map");
const context = canvas.getContext("2d");
let colours = {};
let view = null; // {x, y: the middle in m, scale: px/m}

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["grid", "grid-strong", "ink", "soft", "floor", "view", "anchor", "bad"];
  for (let i = 0; i < 6; i++) names.push(`robot-${i}`);
  colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  dirty = true;
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColours);
new ResizeObserver(() => {
  canvas.width = Math.round(canvas.clientWidth * devicePixelRatio);
  canvas.height = Math.round(canvas.clientHeight * devicePixelRatio);
  view = null;
  dirty = true;
}).observe(canvas);

// What must be on the map. It only ever grows, so that the picture rests while robots drive.
let bounds = null;

function fit() {
  const points = [];
  for (const anchor of health?.anchors ?? []) points.push(anchor.position_m);
  for (const camera of Object.values(health?.cameras ?? {})) points.push(...(camera.view_m ?? []));
  for (const { place } of robots.values()) if (place) points.push(place.position);
  const grown = bounds ? { ...bounds } : { left: Infinity, right: -Infinity, bottom: Infinity, top: -Infinity };
  const before = JSON.stringify(grown);
  for (const [x, y] of points) {
    if (!(x >= grown.left && x <= grown.right && y >= grown.bottom && y <= grown.top)) {
      // Half a metre more than needed, so that it does not grow with every step.
      grown.left = Math.min(grown.left, x - 0.25);
      grown.right = Math.max(grown.right, x + 0.25);
      grown.bottom = Math.min(grown.bottom, y - 0.25);
      grown.top = Math.max(grown.top, y + 0.25);
    }
  }
  if (points.length === 0 && !bounds) return { x: 0, y: 0, scale: Math.min(canvas.clientWidth, canvas.clientHeight) / 4 };
  // A single anchor is not all there is to a room.
  for (const [low, high] of [["left", "right"], ["bottom", "top"]]) {
    const short = Math.max(0, (2 - (grown[high] - grown[low])) / 2);
    grown[low] -= short;
    grown[high] += short;
  }
  bounds = grown;
  if (view && JSON.stringify(grown) === before) return view;
  const scale = Math.min(canvas.clientWidth / (grown.right - grown.left), canvas.clientHeight / (grown.top - grown.bottom));
  return { x: (grown.left + grown.right) / 2, y: (grown.bottom + grown.top) / 2, scale };
}

function draw() {
  requestAnimationFrame(draw);
  if (!dirty || canvas.width === 0) return;
  dirty = false;
  view = fit();
  const { clientWidth: width, clientHeight: height } = canvas;
  const toX = (x) => width / 2 + (x - view.x) * view.scale;
  const toY = (y) => height / 2 - (y - view.y) * view.scale;
  context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "600 14px system-ui, sans-serif";
  context.textBaseline = "middle";
  context.lineJoin = "round";

  drawGrid(width, height, toX, toY);
  for (const [name, camera] of Object.entries(health?.cameras ?? {})) drawCamera(name, camera, toX, toY);
  for (const anchor of health?.anchors ?? []) drawAnchor(anchor, toX, toY);
  for (const robot of robots.values()) if (robot.trail.length) drawTrail(robot, toX, toY);
  for (const [name, robot] of robots) if (robot.place) drawRobot(name, robot, toX, toY);
}

function drawGrid(width, height, toX, toY) {
  // The finest step that leaves the lines at least 36 px apart.
  const step = [0.1, 0.25, 0.5, 1, 2, 5, 10, 20, 50].find((s) => s * view.scale >= 36) ?? 100;
  const across = width / 2 / view.scale;
  const up = height / 2 / view.scale;
  context.lineWidth = 1;
  const line = (strong, x1, y1, x2, y2) => {
    context.strokeStyle = strong ? colours["grid-strong"] : colours.grid;
    context.beginPath();
    context.moveTo(x1, y1);
    context.lineTo(x2, y2);
    context.stroke();
  };
  for (let i = Math.ceil((view.x - across) / step); i * step <= view.x + across; i++) {
    const x = Math.round(toX(i * step)) + 0.5;
    line(i === 0, x, 0, x, height);
  }
  for (let i = Math.ceil((view.y - up) / step); i * step <= view.y + up; i++) {
    const y = Math.round(toY(i * step)) + 0.5;
    line(i === 0, 0, y, width, y);
  }
  // The world's axes, at its origin.
  context.lineWidth = 2;
  context.strokeStyle = colours.soft;
  context.beginPath();
  context.moveTo(toX(0), toY(0) - 34);
  context.lineTo(toX(0), toY(0));
  context.lineTo(toX(0) + 34, toY(0));
  context.stroke();
  label("x", toX(0) + 39, toY(0), colours.soft, "13px");
  label("y", toX(0) - 4, toY(0) - 43, colours.soft, "13px");
  element("scale-bar").style.width = `${step * view.scale}px`;
  setText(element("scale-text"), `${step} m`);
}

function drawCamera(name, camera, toX, toY) {
  if (!camera.located) return;
  context.strokeStyle = context.fillStyle = colours.view;
  context.lineWidth = 1.25;
  context.setLineDash([2, 5]);
  context.beginPath();
  for (const [x, y] of camera.view_m) context.lineTo(toX(x), toY(y));
  context.closePath();
  context.stroke();
  context.setLineDash([]);
  // A lens, as on a floor plan.
  const x = toX(camera.position_m[0]);
  const y = toY(camera.position_m[1]);
  context.beginPath();
  context.roundRect(x - 10, y - 7, 20, 14, 3);
  context.stroke();
  context.beginPath();
  context.arc(x, y, 3.5, 0, 2 * Math.PI);
  context.stroke();
  label(`${name}, ${camera.position_m[2].toFixed(2)} m up`, x + 16, y + 14, colours.soft, "13px");
}

function drawAnchor(anchor, toX, toY) {
  const x = toX(anchor.position_m[0]);
  const y = toY(anchor.position_m[1]);
  const half = Math.max((anchor.size_mm / 2000) * view.scale, 6);
  context.save();
  context.translate(x, y);
  context.rotate((-anchor.yaw_deg * Math.PI) / 180);
  context.strokeStyle = context.fillStyle = colours.anchor;
  context.lineWidth = 2;
  context.strokeRect(-half, -half, 2 * half, 2 * half);
  context.fillRect(-half, -half, half * 0.7, half * 0.7); // its top left corner
  context.restore();
  label(String(anchor.id), x + half + 6, y + half, colours.anchor, "13px");
}

function drawTrail(robot, toX, toY) {
  context.strokeStyle = colours[`robot-${robot.colour}`];
  context.lineWidth = 2.5;
  const trail = robot.trail;
  const newest = trail[trail.length - 1].t;
  for (let i = 1; i < trail.length; i++) {
    if (trail[i].gap) continue;
    context.globalAlpha = 0.6 * Math.max(0, 1 - (newest - trail[i].t) / TRAIL_S) ** 1.5;
    context.beginPath();
    context.moveTo(toX(trail[i - 1].x), toY(trail[i - 1].y));
    context.lineTo(toX(trail[i].x), toY(trail[i].y));
    context.stroke();
  }
  context.globalAlpha = 1;
}

function drawRobot(name, robot, toX, toY) {
  const pose = robot.place;
  const lost = robot.pose !== pose;
  const stale = lost || seconds() - robot.received > STALE_S || socket === null;
  const colour = stale ? colours.soft : colours[`robot-${robot.colour}`];
  const x = toX(pose.position[0]);
  const y = toY(pose.position[1]);
  const { major, minor, angle } = ellipse(pose.covariance);
  context.save();
  context.translate(x, y);
  // An arrowhead about the robot's middle, with a rim that sets it off from the trail.
  const r = Math.min(Math.max(0.11 * view.scale, 12), 22);
  context.save();
  context.rotate(-pose.yaw);
  context.beginPath();
  context.moveTo(r * 1.25, 0);
  context.lineTo(-r * 0.85, r * 0.8);
  context.lineTo(-r * 0.45, 0);
  context.lineTo(-r * 0.85, -r * 0.8);
  context.closePath();
  context.strokeStyle = colours.floor;
  context.lineWidth = 4;
  context.stroke();
  context.fillStyle = colour;
  context.fill();
  context.restore();
  // Where it is to 2 sigma: light inside the arrowhead while it is that small, else around it.
  context.beginPath();
  context.ellipse(0, 0, 2 * major * view.scale, 2 * minor * view.scale, -angle, 0, 2 * Math.PI);
  context.lineWidth = 3;
  context.strokeStyle = colours.floor;
  context.stroke();
  context.lineWidth = 1.5;
  context.strokeStyle = colour;
  context.stroke();
  context.globalAlpha = 0.14;
  context.fill();
  context.restore();
  label(lost ? `${name} was here` : name, x + r * 1.25 + 8, y - r * 0.9, colour, "16px");
}

function label(text, x, y, colour, size) {
  context.font = `600 ${size} system-ui, sans-serif`;
  x = Math.min(x, canvas.clientWidth - context.measureText(text).width - 6);
  // A halo in the floor's colour keeps it readable over lines.
  context.strokeStyle = colours.floor;
  context.lineWidth = 4;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

readColours();
connect();
fetchHealth();
setInterval(fetchHealth, HEALTH_MS);
setInterval(() => {
  if (document.hidden) return;
  showTables();
  // Robots that have gone silent are drawn as such, though nothing arrives.
  if ([...robots.values()].some((robot) => robot.pose && seconds() - robot.received > STALE_S)) dirty = true;
}, TABLE_MS);
requestAnimationFrame(draw);
