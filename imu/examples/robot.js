// A robot in JavaScript, in a browser or in node from version 22: sends its IMU, and gets its pose. No library needed.

const SERVICE = "ws://127.0.0.1:5678"; // wss:// where the service has a certificate
const ROBOT = "rover";
const TOKEN = ""; // the robot's, where the configuration gives it one
const PERIOD_MS = 10; // between samples
const BATCH = 5; // samples sent together

const clock = () => performance.now() / 1000; // s; the samples are stamped by the same one

// Yours: rad/s about x (forward), y (left) and z (up), then m/s2 along them, +9.81 on z at rest.
const readImu = () => [0, 0, 0, 0, 0, 9.81];

// Yours: m, rad; `message` has much more, see the README.
const steer = ({ position: [x, y], yaw, mode }) => console.log(x.toFixed(3), y.toFixed(3), yaw.toFixed(3), mode);

function connect() {
  const socket = new WebSocket(`${SERVICE}/v1/robot`);
  const send = (message) => socket.send(JSON.stringify(message));
  let timer;
  let samples = [];
  socket.onopen = () => send({ type: "hello", robot: ROBOT, token: TOKEN, pose_rate_hz: 20 });
  socket.onmessage = ({ data }) => {
    const received = clock();
    const message = JSON.parse(data);
    if (message.type === "welcome") timer = setInterval(sample, PERIOD_MS);
    else if (message.type === "clock") send({ type: "clock", id: message.id, received, sent: clock() });
    else if (message.type === "pose") steer(message);
    else console.error("the service says:", message.reason ?? message.text);
  };
  socket.onclose = () => {
    clearInterval(timer);
    setTimeout(connect, 1000);
  };
  function sample() {
    samples.push([clock(), ...readImu()]);
    if (samples.length < BATCH) return;
    send({ type: "imu", samples });
    samples = [];
  }
}

connect();
