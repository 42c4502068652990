// The recordings of the black box: each with its download and its report, which the robot draws on request.

import { made } from "./views.js";
import { began, lasted } from "./words.js";

const AGAIN = 1000;

export class Recordings {
  #list;
  #none;
  #reports = new Map(); // by name: the element with the report's button, kept when the row is rebuilt
  #shown = "";

  constructor(list, none) {
    this.#list = list;
    this.#none = none;
  }

  /** Show the list. `barred` is the reason why this user may not download, or ""; `trouble` is the reason why
   *  the list is empty. */
  show(files, barred, trouble = "") {
    const shown = JSON.stringify([files, barred, trouble]);
    if (shown === this.#shown) return; // do not rebuild an unchanged list, so the focus stays
    this.#shown = shown;
    this.#none.textContent = trouble || "There are no recordings.";
    this.#none.hidden = files.length > 0;
    this.#list.replaceChildren(...files.map((one) => this.#row(one, barred)));
  }

  #row(one, barred) {
    const about = made("div", "quiet", [began(one.begin), lasted(one.seconds), one.events].filter(Boolean).join(" · "));
    if (barred) return made("li", "", made("span", "", one.name), about, made("div", "quiet", `download and report are ${barred}`));
    const link = made("a", "", one.name);
    link.href = `api/recordings/${encodeURIComponent(one.name)}`;
    link.download = one.name;
    if (!this.#reports.has(one.name)) this.#reports.set(one.name, this.#offer(one.name));
    return made("li", "", link, about, this.#reports.get(one.name));
  }

  #offer(name) {
    const place = made("div", "report");
    place.setAttribute("role", "status");
    const button = made("button", "", "Report");
    button.setAttribute("aria-label", `Report of ${name}`);
    button.addEventListener("click", () => this.#draw(name, place, button));
    place.append(button);
    return place;
  }

  async #draw(name, place, button) {
    for (;;) {
      const told = await ask(name);
      if (told.report === "ready") {
        const link = made("a", "", "Open the report");
        link.href = told.href;
        link.target = "_blank";
        link.rel = "noopener";
        return place.replaceChildren(button, " ", link);
      }
      if (told.report !== "drawing" && told.report !== "busy") return place.replaceChildren(button, made("span", "warn", ` ${told.text}`));
      const how = told.report === "busy" ? told.text : `drawing: ${told.percent ?? 0} %, ${Math.round(told.seconds ?? 0)} s`;
      place.replaceChildren(how);
      await new Promise((done) => setTimeout(done, AGAIN));
    }
  }
}

/** Request the progress of the report of a recording. The first request starts the drawing. */
async function ask(name) {
  try {
    const way = `api/recordings/${encodeURIComponent(name)}/report`;
    const answer = await fetch(way, { method: "POST", signal: expiring(15000) });
    const told = await answer.json();
    return told.report ? told : { text: told.error };
  } catch {
    return { text: "no answer from the robot" };
  }
}
