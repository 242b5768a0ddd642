/** Asking the gateway over HTTP: each question ends, and what failed is asked again as long as somebody wants it. */

const PATIENCE_MS = 3000;
const AGAIN_MS = 1000;

/** What a path of this page gives as JSON; null where it gives nothing, or not in time. */
export async function get(path) {
  try {
    const response = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS) });
    return response.ok ? await response.json() : null;
  } catch {
    return null;
  }
}

/** For `Types`: the definition of a type, or an Error in time. */
export async function soon(url) {
  return (await fetch(url, { signal: AbortSignal.timeout(PATIENCE_MS) })).json();
}

/** What `attempt()` gives, tried until it does or `wanted()` is false: then null. `failed(text)` is told each other reason. */
export async function persisted(attempt, wanted, failed, pauseMs = AGAIN_MS) {
  let before = "";
  while (wanted()) {
    try {
      return await attempt();
    } catch (error) {
      if (wanted() && error.message !== before) failed((before = error.message));
    }
    await new Promise((resolve) => setTimeout(resolve, pauseMs));
  }
  return null;
}
