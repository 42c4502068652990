// The recordings of the black box, each with its download.

import { made } from "./views.js";
import { began, lasted } from "./words.js";

export class Recordings {
  #list;
  #none;
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
    const about = made("div", "quiet", [began(one.begin), lasted(one.seconds), one.being_recorded && "being recorded"].filter(Boolean).join(" · "));
    if (barred) return made("li", "", made("span", "", one.name), about, made("div", "quiet", `the download is ${barred}`));
    const link = made("a", "", one.name);
    link.href = `api/recordings/${encodeURIComponent(one.name)}`;
    link.download = one.name;
    return made("li", "", link, about);
  }
}
