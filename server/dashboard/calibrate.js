// What to do next, and the live picture with where the board has been, is, and is wanted.
const what = document.getElementById("what");
const canvas = document.getElementById("picture");
const criteria = document.getElementById("criteria");
const context = canvas.getContext("2d");

let state = null;
let picture = null;
// The state that the picture came with: pictures are fewer than states.
let drawn = null;
// A view that was taken is shown for a moment, in ms.
const FLASH = 700;
let flashUntil = 0;
let ended = false;

function connect() {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(`${scheme}//${location.host}/v1/calibration`);
  socket.binaryType = "blob";
  socket.onmessage = async ({ data }) => {
    if (typeof data === "string") {
      show(JSON.parse(data));
    } else {
      const belonging = state;
      picture = await createImageBitmap(data);
      drawn = belonging;
      draw();
    }
  };
  socket.onclose = () => {
    if (ended) return;
    what.className = "trouble";
    what.textContent = "No connection to steadfix calibrate. Trying again.";
    setTimeout(connect, 1000);
  };
}

function show(next) {
  if (state && next.views > state.views) flashUntil = performance.now() + FLASH;
  state = next;
  ended = next.ended;
  document.getElementById("board").textContent = next.board;
  document.getElementById("views").textContent = next.views;
  what.className = next.state;
  what.textContent = next.text;
  criteria.replaceChildren(...next.criteria.map(criterion));
  draw();
}

function criterion({ met, part, text }) {
  const item = document.createElement("li");
  item.className = met ? "met" : "";
  item.textContent = text;
  const bar = document.createElement("progress");
  bar.value = part;
  item.append(bar);
  return item;
}

function draw() {
  if (!picture) return;
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  const { width, height } = canvas;
  context.drawImage(picture, 0, 0);
  const cells = drawn.cells.length;
  context.lineWidth = 1;
  context.strokeStyle = "rgb(255 255 255 / 35%)";
  context.fillStyle = "rgb(40 190 100 / 20%)";
  drawn.cells.forEach((row, y) =>
    row.forEach((seen, x) => {
      const box = [(x * width) / cells, (y * height) / cells, width / cells, height / cells];
      if (seen) context.fillRect(...box);
      context.strokeRect(...box);
    }),
  );
  outline(drawn.target, "#f59e0b", [14, 9]);
  outline(drawn.outline, "#3b82f6", []);
  if (performance.now() < flashUntil) {
    context.lineWidth = 16;
    context.strokeStyle = "rgb(40 190 100)";
    context.setLineDash([]);
    context.strokeRect(0, 0, width, height);
    setTimeout(draw, FLASH);
  }
}

// Corners as parts of the picture
function outline(corners, colour, dash) {
  if (!corners) return;
  context.beginPath();
  corners.forEach(([x, y]) => context.lineTo(x * canvas.width, y * canvas.height));
  context.closePath();
  context.lineWidth = 5;
  context.strokeStyle = colour;
  context.setLineDash(dash);
  context.stroke();
  context.setLineDash([]);
}

connect();
