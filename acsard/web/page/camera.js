// The camera beside the stick: fetches one picture after another, draws it, and shows its age. A picture is marked if
// no newer one arrives in time, because a person drives by what the picture shows.

import { age } from "./words.js";

const FROZEN = 800; // age of a picture, ms, above which it is marked; the mark appears within 1 s
const AGAIN = 500; // ms before the next attempt after a failure
const LEAST = 50; // ms between two requests, so that a page leaves room for other pages with the same token

export class Camera {
  #figure;
  #canvas;
  #words;
  #at = -Infinity; // time at which the shown picture reached the robot's computer, by performance.now()
  #tag = "";
  #trouble = "";
  #shows = false;
  #runs = false;
  /** Whether the page has a connection. Without one, the token may have expired, and each request would be refused. */
  connected = false;

  constructor(figure) {
    this.#figure = figure;
    this.#canvas = figure.querySelector("canvas");
    this.#words = figure.querySelector("figcaption");
  }

  /** Show the camera, or hide it. */
  show(wanted) {
    this.#shows = wanted;
    this.#figure.hidden = !wanted;
    if (wanted && !this.#runs) this.#run();
  }

  /** Show how old the picture is at `now`, ms. */
  look(now) {
    if (!this.#shows) return;
    const old = now - this.#at;
    const frozen = old > FROZEN;
    this.#figure.classList.toggle("frozen", frozen);
    const since = old === Infinity ? "NO PICTURE" : `${frozen ? "FROZEN " : ""}${age(old)}`;
    const words = [since, frozen ? this.#trouble : ""].filter(Boolean).join(": ");
    if (this.#words.textContent !== words) this.#words.textContent = words;
  }

  async #run() {
    this.#runs = true;
    while (this.#shows) {
      const begun = performance.now();
      this.#trouble = document.hidden ? "the page is hidden" : !this.connected ? "no connection" : await this.#fetched();
      const pause = this.#trouble ? AGAIN : LEAST - (performance.now() - begun);
      if (pause > 0) await new Promise((done) => setTimeout(done, pause));
    }
    this.#runs = false;
  }

  /** Fetch and draw the next picture. Returns why there is none, or "". */
  async #fetched() {
    const asked = performance.now();
    try {
      const headers = this.#tag ? { "If-None-Match": this.#tag } : {};
      const answer = await fetch("api/camera", { headers, cache: "no-store", signal: expiring(5000) });
      if (answer.status === 304) return "";
      // The answer's `detail` is for the person who sets up the camera, who can request api/camera.
      if (!answer.ok) return (await answer.json()).error ?? `${answer.status}`;
      // The time for which the request traveled is unknown and counts as 0, so the shown age is never too low.
      const held = Number(answer.headers.get("Waited-Ms")) - Number(answer.headers.get("Age-Ms"));
      const picture = await createImageBitmap(await answer.blob());
      this.#tag = answer.headers.get("ETag");
      this.#at = asked + held;
      this.#canvas.width = picture.width;
      this.#canvas.height = picture.height;
      this.#canvas.getContext("2d").drawImage(picture, 0, 0);
      picture.close();
      return "";
    } catch {
      return "no answer, or not a picture";
    }
  }
}
