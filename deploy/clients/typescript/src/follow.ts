// Prints where the robot is: `npm start -- [WEBSOCKET [ID]]`, through zenoh-bridge-remote-api.

import { Config, Sample, Session } from "@eclipse-zenoh/zenoh-ts";
import WebSocket from "ws";

// Browsers and Node 22 or later have a global WebSocket.
globalThis.WebSocket ??= WebSocket as unknown as typeof globalThis.WebSocket;

interface Odometry {
  pose: { pose: { position: { x: number; y: number } } };
  twist: { twist: { linear: { x: number } } };
}

const [locator = "ws/127.0.0.1:10000", robot = "acsar"] = process.argv.slice(2);

function show(sample: Sample): void {
  const odom: Odometry = JSON.parse(sample.payload().toString());
  const { x, y } = odom.pose.pose.position;
  const speed = odom.twist.twist.linear.x;
  console.log(`x ${x.toFixed(3)} m, y ${y.toFixed(3)} m, ${speed.toFixed(3)} m/s`);
}

const session = await Session.open(new Config(locator));
await session.declareSubscriber(`acsard/${robot}/json/odom`, { handler: show });
