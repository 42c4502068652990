// Permissions of this client, as the server reports them. A control that the robot would refuse is shown as disabled.

/** Return why this client may not do something ("drive", a service, ...), in words, or "" if it may. */
export function barred(hello, what) {
  return hello ? (hello.barred[what] ?? "") : "no connection yet";
}

/** Return the hint at the stick while it is not held: how to drive, or why this user cannot. `other` is the
 *  id of a robot that is not the page's own. */
export function hint(hello, other) {
  if (other) return `To drive ${other}, open its own page.`;
  return barred(hello, "drive") ? "You may watch and stop, but not drive." : "Hold and push to drive; release to stop.";
}

/** Disable the controls that this client may not use and explain why, on the control and in its description.
 *  `reason` disables all of them for that reason. `hello` is undefined while no robot has answered. */
export function permit(hello, reason = "") {
  document.getElementById("barred").textContent = reason || barred(hello, "drive");
  for (const one of document.querySelectorAll("[data-does]")) {
    const why = reason || barred(hello, one.dataset.does);
    if ("disabled" in one) one.disabled = Boolean(why);
    else one.setAttribute("aria-disabled", String(Boolean(why)));
    one.title = why;
  }
}
