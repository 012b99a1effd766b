// Whether the service answers: a notice while it does not, and no press of a button lost in silence.
"use strict";

const CHECK_MS = 1500; // between two checks
const PATIENCE_MS = 2500; // for the answer to a check: the notice is there after 4 s at most
const root = document.documentElement.dataset.root;
const away = document.getElementById("away"), lost = document.getElementById("lost");
let since = null, source = null;

const clock = (moment) => moment.toLocaleTimeString([], { hour12: false });

function follow() {
  source?.close();
  source = new EventSource(`${root}/ui/changes`);
  source.addEventListener("change", () => announce());
}

function announce() {
  document.body.dispatchEvent(new CustomEvent("server-change"));
}

function note(isAnswering) {
  if (isAnswering && since) {
    since = null;
    away.hidden = true;
    // A proxy's own error ends an event stream for good, so it is opened again.
    if (source) follow();
    announce();
  } else if (!isAnswering) {
    since ??= new Date();
    away.textContent = `The service is away since ${clock(since)}. This page shows the state of then, and goes on by itself when the service is back.`;
    away.hidden = false;
  }
}

async function check() {
  let isAnswering = false;
  try {
    isAnswering = (await fetch(`${root}/livez`, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS) })).ok;
  } catch { /* no answer: it is away */ }
  note(isAnswering);
  setTimeout(check, CHECK_MS);
}
setTimeout(check, CHECK_MS);

if (document.body.hasAttribute("data-live")) follow();

// What a user pressed or filled in, by the word that stands on it.
function nameOf(element) {
  const button = element.matches("form") ? element.querySelector("button") : element;
  return button?.getAttribute("aria-label") || button?.textContent.trim() || element.getAttribute("aria-label") || "The search";
}

// A request of htmx that failed: say which press it was, and offer it again.
function tellLost(element, reason) {
  const item = document.createElement("p"), text = document.createElement("span"), again = document.createElement("button");
  item.className = "notice";
  text.textContent = `“${nameOf(element).slice(0, 60)}” had no effect: ${reason} `;
  again.textContent = "Try again";
  again.type = "button";
  again.addEventListener("click", () => {
    // The part of the page may have been drawn anew since, a moment ago even: then htmx has not bound
    // its elements yet, and would miss the press. The notice stays until the service has answered.
    const target = element.isConnected ? element : document.getElementById(element.id);
    if (!target) {
      location.reload();
      return;
    }
    htmx.process(target);
    htmx.trigger(target, target.matches("form") ? "submit" : "click");
  });
  item.append(text, again);
  lost.replaceChildren(item);
}

const isPress = ({ elt }) => elt.matches("button, a, form");
const unanswered = ({ detail }) => { if (isPress(detail)) tellLost(detail.elt, "the service did not answer."); };
document.body.addEventListener("htmx:sendError", unanswered);
document.body.addEventListener("htmx:timeout", unanswered);
document.body.addEventListener("htmx:responseError", ({ detail }) => {
  if (!isPress(detail) && !detail.elt.matches("aside")) return;
  let reason = `the service answered with status ${detail.xhr.status}.`;
  try {
    reason = `${JSON.parse(detail.xhr.responseText).detail}.`;
  } catch { /* not from the service: a proxy in front of it */ }
  tellLost(detail.elt, reason);
});
document.body.addEventListener("htmx:afterRequest", ({ detail }) => {
  if (detail.successful && isPress(detail)) lost.replaceChildren();
});
