/** Who looks at a page, and a form for who has to show a token first. */

import { h, say } from "./dom.js";

/** Who asks, and what he may do: as soon as the gateway is there. */
export async function asked() {
  for (;;) {
    try {
      return await (await fetch("/view/me", { cache: "no-store" })).json();
    } catch {
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

/** Ask for a token, or for the code that `macs token show --qr` shows. Loads the page again when it is let in. */
export function login() {
  const input = h("input", { id: "token", type: "password", autocomplete: "current-password", required: true });
  const problem = h("p", { class: "bad", role: "alert" });
  const form = h(
    "form",
    { class: "login" },
    h("h1", {}, "macs"),
    h("label", { for: "token" }, "Token, or pairing code of six digits"),
    input,
    h("button", { type: "submit" }, "Sign in"),
    problem,
  );
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const shown = input.value.trim();
    const token = /^\d{6}$/.test(shown) ? (await post("/pair", { code: shown }))?.token : shown;
    if (token && (await post("/login", { token }))?.ok) location.reload();
    else say(problem, "It is not valid here.");
  });
  document.body.replaceChildren(h("main", { class: "middle" }, form));
  input.focus();
}

async function post(path, body) {
  const response = await fetch(path, { method: "POST", body: JSON.stringify(body) });
  return response.ok ? response.json() : null;
}
