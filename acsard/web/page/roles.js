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

/** Switch off what this role may not, and say why on it; or all of it, for another reason. `role` is
 *  "" while nobody knows. */
export function permit(role, reason = "") {
  for (const one of document.querySelectorAll("[data-least]")) {
    const why = reason || barred(role, one.dataset.least);
    if ("disabled" in one) one.disabled = Boolean(why);
    else one.setAttribute("aria-disabled", String(Boolean(why)));
    one.title = why;
  }
}
