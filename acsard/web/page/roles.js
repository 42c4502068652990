// Permissions of each role. A control that the robot would refuse is shown as disabled.

const ROLES = ["viewer", "operator", "maintainer"];

export function may(role, least) {
  return ROLES.indexOf(role) >= ROLES.indexOf(least);
}

/** Return why the role is not sufficient, in words, or "" if it is. */
export function barred(role, least) {
  if (may(role, least)) return "";
  return role ? `for who is ${least}; you are ${role}` : "no connection yet";
}

/** Return the hint at the stick while it is not held: how to drive, or why this user cannot. `other` is the
 *  id of a robot that is not the page's own. */
export function hint(role, other) {
  if (other) return `To drive ${other}, open its own page.`;
  return may(role, "operator") ? "Hold and push to drive; let go to stop." : "You may watch and stop, not drive.";
}

/** Disable the controls that this role may not use and explain why, on the control and in its description.
 *  `reason` disables all of them for that reason. `role` is "" while it is unknown. */
export function permit(role, reason = "") {
  document.getElementById("barred").textContent = reason || barred(role, "operator");
  for (const one of document.querySelectorAll("[data-least]")) {
    const why = reason || barred(role, one.dataset.least);
    if ("disabled" in one) one.disabled = Boolean(why);
    else one.setAttribute("aria-disabled", String(Boolean(why)));
    one.title = why;
  }
}
