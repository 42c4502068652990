// Access to the page: exchanges an invitation for a cookie, explains why access is refused, and disables each
// control that the robot would refuse to this client.

import { text } from "./views.js";

const AGAIN = 1000; // ms before the next attempt, while the robot does not answer an invitation
const INVALID = "This invitation is not valid: it has expired, was revoked, or is incomplete. Ask for a new one.";

/** Exchange the token of an invitation (behind the # of the URL) for a cookie. If the present cookie has more
 *  permissions, ask first. The token is removed from the URL once it was accepted or finally rejected. Returns
 *  the reason for a rejection, or "" if there is no rejection or no invitation. `waiting(why)` is called while
 *  the robot does not answer. */
export async function invited(waiting) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return "";
  for (let replace = false; ; ) {
    const headers = { "Content-Type": "application/json" };
    // The redirect leads to this page, which need not be fetched again.
    const how = { method: "POST", headers, body: JSON.stringify({ token, replace }), redirect: "manual" };
    const { status, error } = await request("token", how);
    if (status === 409 && !replace && (replace = confirm(`${error}. Use the link anyway?`))) continue;
    if (status && status < 500) {
      history.replaceState(null, "", location.pathname);
      return status === 401 ? INVALID : status === 409 ? "" : error;
    }
    waiting(`Your invitation has no answer yet: ${error}. This page sends it again.`);
    await new Promise((done) => setTimeout(done, AGAIN));
  }
}

/** Return why a WebSocket is refused, as {why, barred}, because no browser reports this: another request is refused for
 *  the same reason. `barred` means that the robot refuses everything from this browser, also STOP, so a repeated attempt
 *  is pointless. */
export async function refusal() {
  const { status, error } = await request("api/whoami", {}, 2000);
  return { why: error, barred: BARRED.includes(status) };
}

/** Return the answer to an HTTP request as {status, body, error}. `error` is "" if it succeeded, and `status` is 0 if
 *  there was no answer within `within` ms. */
export async function request(path, how = {}, within = 5000) {
  try {
    const answer = await fetch(path, { ...how, signal: expiring(within) });
    if (answer.type === "opaqueredirect") return { status: 303, body: {}, error: "" };
    const body = await answer.json();
    return { status: answer.status, body, error: answer.ok ? "" : (body.error ?? `${answer.status}`) };
  } catch {
    return { status: 0, body: {}, error: "no answer from the robot" };
  }
}

/** Return why this client may not do `what` ("drive", a service, ...), in words, or "" if it may. */
export function barred(hello, what) {
  return hello ? (hello.barred[what] ?? "") : "no connection yet";
}

/** Disable the controls that this client may not use now and explain why, on the control and in its description.
 *  `absent` says that the robot is not there, or is "". `needless` maps each control that would change nothing now to
 *  the reason. `hello` is undefined while no robot has answered. */
export function permit(hello, absent, needless = {}) {
  const sets = barred(hello, "set");
  text("barred", barred(hello, "drive") || absent || (sets && `Settings are ${sets}.`));
  for (const control of document.querySelectorAll("[data-does]")) {
    const why = barred(hello, control.dataset.does) || absent || needless[control.dataset.does] || "";
    if ("disabled" in control) control.disabled = Boolean(why);
    else control.setAttribute("aria-disabled", String(Boolean(why)));
    if (control.title !== why) control.title = why;
  }
}
