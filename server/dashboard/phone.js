// The page at `/phone`: streams the phone's motion to /v1/robot as a robot's IMU, and shows the pose that comes back.
//
// Axes. The events are in the device's: x to the right and y to the top of the screen as the phone is usually held, z
// out of the screen, however the screen's content is turned. A robot's are x forward, y left, z up. Forward is the top
// of the screen as it is shown when the streaming starts, which is turned clockwise by screen.orientation.angle.
// rotationRate is in degrees a second, alpha about x, beta about y, gamma about z: so all browsers have it, and since
// 2018 the specification. accelerationIncludingGravity reads +9.8 upwards at rest by the specification and on Android,
// and the negative of all on iOS; which it is here tells the orientation, which is the same everywhere.

const BATCH_S = 0.05;
const POSE_RATE_HZ = 10;
const SENSORS_S = 3; // until then there must be motion data
const SIGN_S = 1; // until then the orientation must tell the sign of the acceleration, else the kind of phone does

const RAD = Math.PI / 180;
const element = (id) => document.getElementById(id);
const seconds = () => performance.now() / 1000; // the phone's clock; events are stamped by it

let session = null; // the streaming, from Start to Stop

// Permission and sensors

async function allowed() {
  // iOS asks the user, and only as the answer to a tap.
  const kinds = [window.DeviceMotionEvent, window.DeviceOrientationEvent].filter((kind) => kind?.requestPermission);
  try {
    const answers = await Promise.all(kinds.map((kind) => kind.requestPermission()));
    return answers.every((answer) => answer === "granted");
  } catch {
    return false;
  }
}

function screenAngle() {
  return screen.orientation?.angle ?? window.orientation ?? 0;
}

// Device axes to the robot's, forward being the top of a screen that is turned by `angle` degrees.
function toBody([x, y, z], angle) {
  const s = Math.sin(angle * RAD);
  const c = Math.cos(angle * RAD);
  return [s * x + c * y, -c * x + s * y, z];
}

// The unit vector upwards in device axes, of the angles beta and gamma about x and then y.
function upwards({ beta, gamma }) {
  const [b, g] = [beta * RAD, gamma * RAD];
  return [-Math.cos(b) * Math.sin(g), Math.sin(b), Math.cos(b) * Math.cos(g)];
}

function isApple() {
  const mac = navigator.platform === "MacIntel" && navigator.maxTouchPoints > 1; // what an iPad says it is
  return mac || /iPhone|iPad|iPod/.test(navigator.userAgent);
}

function turned(event) {
  if (event.beta !== null && event.gamma !== null) session.up = upwards(event);
}

function moved(event) {
  const force = event.accelerationIncludingGravity;
  const rate = event.rotationRate;
  // A computer without the sensors sends events as well, of nulls.
  if (force?.x == null) return;
  if (rate?.alpha == null) {
    trouble("This phone has no gyroscope, or its browser gives none: it cannot be an IMU.");
    return;
  }
  const f = [force.x, force.y, force.z];
  session.sign ??= signOf(f);
  if (session.sign === null) return;
  // In some browsers an event is stamped by another clock.
  const stamped = Math.abs(event.timeStamp / 1000 - seconds()) < 1 ? event.timeStamp / 1000 : seconds();
  const gyro = toBody([rate.alpha, rate.beta, rate.gamma], session.angle).map((value) => value * RAD);
  const accel = toBody(f, session.angle).map((value) => value * session.sign);
  session.samples.push([stamped, ...gyro, ...accel]);
  session.accel = accel;
  session.count += 1;
  if (stamped - session.samples[0][0] >= BATCH_S) flush();
}

// +1 where the acceleration at rest is upwards, -1 where it is downwards; null as long as nothing tells.
function signOf(f) {
  if (session.up) {
    const along = f[0] * session.up[0] + f[1] * session.up[1] + f[2] * session.up[2];
    if (Math.abs(along) > 5) return Math.sign(along);
  }
  if (seconds() - session.began < SIGN_S) return null;
  return isApple() ? -1 : 1;
}

// The connection

function flush() {
  const samples = session.samples;
  session.samples = [];
  // What cannot leave at once is of no use later.
  if (session.welcomed && session.socket.bufferedAmount < 16384) send({ type: "imu", samples });
}

function send(message) {
  session.socket.send(JSON.stringify(message));
}

function connect() {
  const opened = session;
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(`${scheme}//${location.host}/v1/robot`);
  opened.socket = socket;
  opened.welcomed = false;
  let refused = false;
  socket.onopen = () => send({ type: "hello", robot: opened.robot, token: opened.token, pose_rate_hz: POSE_RATE_HZ });
  socket.onmessage = ({ data }) => {
    if (session !== opened) return;
    const received = seconds();
    const message = JSON.parse(data);
    if (message.type === "clock") send({ type: "clock", id: message.id, received, sent: seconds() });
    else if (message.type === "pose") opened.pose = { ...message, received };
    else if (message.type === "welcome") {
      opened.welcomed = true;
      opened.pause = 0.5;
      trouble("");
    } else if (message.type === "notice") trouble(message.text);
    else if (message.type === "error") {
      refused = !opened.welcomed && !message.retry;
      trouble(message.reason);
    }
  };
  socket.onclose = () => {
    opened.welcomed = false;
    if (session !== opened) return;
    if (refused) {
      stop();
      return;
    }
    opened.retry = setTimeout(connect, opened.pause * 1000);
    opened.pause = Math.min(2 * opened.pause, 5);
  };
}

// Start and stop

async function start(event) {
  event.preventDefault();
  if (session) return;
  trouble("");
  const robot = element("robot").value.trim();
  const token = element("token").value;
  const opened = { robot, token, angle: screenAngle(), sign: null, samples: [], count: 0, pause: 0.5 };
  session = opened;
  if (!(await allowed())) {
    stop();
    trouble(
      "The browser does not allow motion sensors. iPhone: close this tab, open it anew and tap Allow. " +
        "Android: allow motion sensors in the site's settings.",
    );
    return;
  }
  try {
    localStorage.setItem("steadfix-phone", JSON.stringify({ robot, token }));
  } catch {
    // A private tab keeps nothing.
  }
  opened.began = opened.counted = seconds();
  addEventListener("devicemotion", moved);
  addEventListener("deviceorientation", turned);
  keepAwake();
  connect();
  opened.timer = setInterval(show, 500);
  element("setup").hidden = true;
  element("live").hidden = false;
  show();
}

function stop() {
  const stopped = session;
  session = null;
  removeEventListener("devicemotion", moved);
  removeEventListener("deviceorientation", turned);
  clearInterval(stopped.timer);
  clearTimeout(stopped.retry);
  stopped.socket?.close();
  stopped.wakeLock?.release();
  element("setup").hidden = false;
  element("live").hidden = true;
  state("", "Not streaming");
}

// A phone whose screen is off has no sensors for a page.
async function keepAwake() {
  const opened = session;
  try {
    opened.wakeLock = await navigator.wakeLock?.request("screen");
  } catch {
    // Then it is up to the user.
  }
}

document.addEventListener("visibilitychange", () => {
  if (session && !document.hidden) keepAwake();
});

// The words and numbers

function state(kind, text) {
  element("state").className = kind;
  element("state-text").textContent = text;
}

function trouble(text) {
  element("trouble").textContent = text;
  element("trouble").hidden = text === "";
}

function show() {
  const now = seconds();
  const rate = session.count / Math.max(now - session.counted, 0.1);
  session.count = 0;
  session.counted = now;
  const pose = session.pose && now - session.pose.received < 2 ? session.pose : null;
  element("rate").textContent = rate.toFixed(0);
  element("up").textContent = session.accel ? session.accel[2].toFixed(2) : "–";
  element("x").textContent = pose ? pose.position[0].toFixed(3) : "–";
  element("y").textContent = pose ? pose.position[1].toFixed(3) : "–";
  element("yaw").textContent = pose ? (pose.yaw / RAD).toFixed(1) : "–";
  element("mode").textContent = pose ? pose.mode : "–";
  element("arrow").style.transform = `rotate(${session.angle - screenAngle()}deg)`;
  if (!session.accel && now - session.began > SENSORS_S) {
    trouble("No motion data come. Does this device have a gyroscope, and may this site use the motion sensors?");
  }
  if (!session.welcomed) state("bad", "No connection");
  else if (rate === 0) state("fair", "Connected, no motion data");
  else state("good", `Streaming as ${session.robot}`);
}

// The page

function open() {
  let kept = {};
  try {
    kept = JSON.parse(localStorage.getItem("steadfix-phone")) ?? {};
  } catch {
    // Nothing is kept.
  }
  element("robot").value = new URLSearchParams(location.hash.slice(1)).get("robot") ?? kept.robot ?? "";
  element("token").value = kept.token ?? "";
  if (!window.isSecureContext) {
    trouble("Browsers give motion data to pages of https:// only: the service needs a certificate, see the README.");
  } else if (!window.DeviceMotionEvent) trouble("This browser gives no motion data.");
  else {
    element("form").addEventListener("submit", start);
    element("stop").addEventListener("click", stop);
    return;
  }
  element("start").disabled = true;
}

open();
