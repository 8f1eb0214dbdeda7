// Starts the page: views, colours, token, connection.

import { Connection } from "./connection.js";
import { ask, byId, setText } from "./dom.js";
import { LiveView } from "./live.js";
import { RecordingsView } from "./recordings.js";
import { SettingsView } from "./settings.js";

const VIEWS = ["live", "settings", "recordings"];
const THEMES = [["auto", "◐", "as the system has them"], ["dark", "☾", "dark"], ["light", "☀", "light"]];

function startTheme(redraw) {
  let at = Math.max(0, THEMES.findIndex(([name]) => name === localStorage.getItem("theme")));
  const show = () => {
    const [name, mark, words] = THEMES[at];
    if (name === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = name;
    setText(byId("theme-mark"), mark);
    byId("theme").setAttribute("aria-label", `Colours: ${words}`);
    byId("theme").title = `Colours: ${words}`;
    redraw();
  };
  byId("theme").addEventListener("click", () => {
    at = (at + 1) % THEMES.length;
    localStorage.setItem("theme", THEMES[at][0]);
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  show();
}

function startTabs(shown) {
  const tabs = VIEWS.map((name) => byId(`tab-${name}`)).filter((tab) => !tab.hidden);
  const show = (name, focus) => {
    for (const tab of tabs) {
      const selected = tab.id === `tab-${name}`;
      tab.setAttribute("aria-selected", String(selected));
      tab.tabIndex = selected ? 0 : -1;
      if (selected && focus) tab.focus();
    }
    for (const view of VIEWS) byId(`view-${view}`).hidden = view !== name;
    history.replaceState(null, "", `#${name}`);
    shown(name);
  };
  tabs.forEach((tab, at) => {
    tab.addEventListener("click", () => show(tab.id.slice(4), false));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) show(tabs[(at + step + tabs.length) % tabs.length].id.slice(4), true);
      else if (event.key === "Home") show(tabs[0].id.slice(4), true);
      else if (event.key === "End") show(tabs[tabs.length - 1].id.slice(4), true);
      else return;
      event.preventDefault();
    });
  });
  const wanted = location.hash.slice(1);
  show(tabs.some((tab) => tab.id === `tab-${wanted}`) ? wanted : tabs[0].id.slice(4), false);
}

function askForToken() {
  for (const view of VIEWS) byId(`view-${view}`).hidden = true;
  byId("view-login").hidden = false;
  byId("token").focus();
}

function showConnection({ open, reason }) {
  byId("connection").classList.toggle("open", open);
  setText(byId("connection-text"), open ? "live" : reason || "no connection");
}

async function start() {
  byId("login").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await ask("/api/login", { token: byId("token").value });
      location.reload();
    } catch (error) {
      setText(byId("login-error"), error.message);
      byId("token").select();
    }
  });
  window.addEventListener("token-needed", askForToken);
  let session;
  try {
    session = await ask("/api/session");
  } catch (error) {
    showConnection({ open: false, reason: error.message });
    setTimeout(start, 2000);
    return;
  }
  if (session.token_needed) {
    startTheme(() => {});
    askForToken();
    return;
  }
  const connection = new Connection();
  const live = new LiveView(connection);
  const settings = new SettingsView(connection, session.live);
  const recordings = new RecordingsView(settings);
  connection.addEventListener("connection", (event) => {
    live.open = event.detail.open;
    showConnection(event.detail);
  });
  byId("tab-live").hidden = !session.live;
  const views = { live, settings, recordings };
  startTabs((name) => {
    connection.pictures = name === "live";
    connection.tellWants();
    if (views[name].show) views[name].show();
    views[name].redraw();
  });
  startTheme(() => {
    for (const view of Object.values(views)) view.redraw();
  });
  if (session.live) connection.open();
  else {
    byId("connection").classList.add("open");
    setText(byId("connection-text"), "recordings");
  }
}

start();
