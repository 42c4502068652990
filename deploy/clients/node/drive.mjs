// Drives the robot forward for two seconds and prints where it is: `node drive.mjs [ADDRESS [TOKEN]]`.
// Node 22 or later; Node 20 needs `node --experimental-websocket`.

const [address = "http://127.0.0.1:8080", token] = process.argv.slice(2);
const PERIOD_MS = 50;

const socket = new WebSocket(
  address.replace("http", "ws").replace(/\/$/, "") + "/ws",
  token ? ["acsard", "acsard.token." + token] : [],
);
const say = (message) => socket.send(JSON.stringify(message));
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
let echo; // the newest beat of the robot, by which it knows how old a command is

async function drive(speed, seconds) {
  for (let sent = 0; sent < (seconds * 1000) / PERIOD_MS; sent++) {
    say({ cmd: { linear_x: speed, angular_z: 0 }, echo });
    await pause(PERIOD_MS);
  }
}

socket.onmessage = ({ data }) => {
  const { key, value, refused, reason } = JSON.parse(data);
  if (refused) console.error(`${refused} was refused: ${reason}`);
  if (key === "beat") echo = value;
  if (key !== "odom") return;
  const { x, y } = value.pose.pose.position;
  const speed = value.twist.twist.linear.x;
  console.log(`x ${x.toFixed(3)} m, y ${y.toFixed(3)} m, ${speed.toFixed(3)} m/s`);
};
let done = false;
function lost(reason) {
  if (done) return;
  console.error(reason ? `no connection to ${address}: ${reason}` : `no connection to ${address}`);
  process.exit(1);
}
socket.onerror = () => lost("");
// A closed socket drops every message without an error.
socket.onclose = ({ reason }) => lost(reason);
socket.onopen = async () => {
  say({ subscribe: "beat" });
  say({ subscribe: "odom", rate: 10 });
  while (!echo) await pause(10);
  await drive(0, 0.1); // a zero arms this sender
  await drive(0.2, 2);
  await drive(0, 1);
  done = true;
  socket.close();
};
