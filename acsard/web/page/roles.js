// What each role may: nothing looks as if it could be pressed that would be refused.

const ROLES = ["viewer", "operator", "maintainer"];

export function may(role, least) {
  return ROLES.indexOf(role) >= ROLES.indexOf(least);
}

/** Why not, in words; "" for who may. */
export function barred(role, least) {
  if (may(role, least)) return "";
  return role ? `for who is ${least}; you are ${role}` : "no connection yet";
}

/** What stands at the stick while nobody holds it: how to drive, or why that is not for this one;
 *  `other` is a robot that is seen by the page of another one. */
export function hint(role, other) {
  if (other) return `To drive ${other}, open its own page.`;
  return may(role, "operator") ? "Hold and push to drive; let go to stop." : "You may watch and stop, not drive.";
}

/** Switch off what this role may not, and say why on it and in what describes it; or all of it, for
 *  another reason. `role` is "" while nobody knows. */
export function permit(role, reason = "") {
  document.getElementById("barred").textContent = reason || barred(role, "operator");
  for (const one of document.querySelectorAll("[data-least]")) {
    const why = reason || barred(role, one.dataset.least);
    if ("disabled" in one) one.disabled = Boolean(why);
    else one.setAttribute("aria-disabled", String(Boolean(why)));
    one.title = why;
  }
}
