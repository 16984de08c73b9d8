/** Puts the page together. */

import { Aids } from "./aids.js";
import { takeToken } from "./api.js";
import { CloudView } from "./cloudview.js";
import { Connection } from "./connection.js";
import { addressOf, datasetOf } from "./dataset.js";
import { announce, byId, releaseFocusAfterClicks, setState, setText } from "./dom.js";
import { EpisodeBar } from "./episodebar.js";
import { Hover } from "./hover.js";
import { actionOf, keyTarget } from "./keys.js";
import { TileLabels } from "./labels.js";
import { LiveStatus, shownCameras } from "./livestatus.js";
import { mixings } from "./mixture.js";
import { Panels } from "./panels.js";
import { PROTOCOL } from "./protocol.js";
import { DepthRange } from "./range.js";
import { RecordBar } from "./recordbar.js";
import { ReplayBar } from "./replaybar.js";
import { play, setUpSound } from "./sound.js";
import { Takes } from "./takes.js";
import { Wall } from "./wall.js";
import { WipeLine } from "./wipeline.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Hello} Hello */

const STATE_EVERY_MS = 100;
const KEPT_AGES = 200;
const PROBLEM_MS = 5000;

/**
 * For tests and for a look from the console.
 *
 * @type {{drawn: number, ages: number[]}}
 */
const debug = { drawn: 0, ages: [] };
Object.assign(window, { depthrig: debug });

/** @type {Status | null} */
let status = null;

/** @type {Map<string, import("./types.js").Geometry>} by stream */
const geometries = new Map();

const range = new DepthRange(() => {
  wall.redrawAll((tile) => tile.isDepth || tile === wall.enlarged);
  cloud.redraw();
});
const mixing = mixings(
  () => wall.tiles.values(),
  geometries,
  () => {
    wall.redrawAll((tile) => tile === wall.enlarged);
    wall.askWatch();
  },
);
const wipeLine = new WipeLine(mixing.wipe);
const wall = new Wall({
  watch: (watched) => connection.watch(watched),
  tables: range.tables,
  onEnlarged: (tile) => {
    mixing.enlarged(tile);
    wipeLine.enlarged(tile);
    aids.enlarged(tile);
    hasReference.hidden = tile === null || tile.isDepth;
    reference?.enlarged(tile);
    // Marks were set for tiles of another size.
    hover.hide();
  },
  mixtureOf: (tile) => mixing.of(tile),
  onDrawn: (tile, ageMs) => {
    debug.drawn += 1;
    debug.ages.push(ageMs);
    if (debug.ages.length > KEPT_AGES) {
      debug.ages.shift();
    }
    labels.drawn(tile, ageMs);
    aids.drawn(tile);
    reference?.drawn(tile);
  },
  isMeasured: () => aids.isShown,
  watchInstead: () => cloud.watch(),
  takeInstead: (stream, delivery) => cloud.accept(stream, delivery),
});
const aids = new Aids({ askWatch: () => wall.askWatch(), geometries });
const cloud = new CloudView({
  askWatch: () => wall.askWatch(),
  geometries,
  range: () => range.current,
  state: () => ({
    isLive: connection.isLive,
    isPaused: replayBar.isShown && replayBar.isWaiting,
    fastestHz: replayBar.isShown ? replayBar.fastestHz : Infinity,
  }),
  onToggled: (isOpen) => {
    byId("wall", HTMLElement).hidden = isOpen;
    hover.hide();
  },
});
Object.assign(debug, { view: cloud.facts, aids });
const labels = new TileLabels(wall);
const hover = new Hover(wall.tiles, (id, place) => connection.askPixel(id, place));
/** @type {import("./episodespanel.js").EpisodesPanel | null} `null` before its panel is opened first */
let episodes = null;
const episodeBar = new EpisodeBar(() => episodes?.look());
const recordBar = new RecordBar((next) => episodeBar.update(next));
const hasReference = byId("show-reference", HTMLButtonElement);
/** @type {import("./reference.js").Reference | null} `null` before it is asked for first */
let reference = null;
/** @type {import("./recordings.js").Recordings | null} `null` before its panel is opened first */
let recordings = null;
/** @type {import("./signalspanel.js").SignalsPanel | null} `null` before its panel is opened first */
let signals = null;
const takes = new Takes(recordBar, (entry) => recordings?.marked(entry));
const replayBar = new ReplayBar(
  (command, body) => connection.steer(command, body),
  () => watchDataset(null),
);
const panels = new Panels({
  recordings: { title: "Recordings", load: loadRecordings },
  sync: { title: "Synchronisation", load: async () => new (await import("./syncpanel.js")).SyncPanel() },
  doctor: {
    title: "Doctor",
    load: async () => new (await import("./doctorpanel.js")).DoctorPanel((report) => recordBar.setDoctor(report)),
  },
  controls: { title: "Camera controls", load: async () => new (await import("./controlspanel.js")).ControlsPanel() },
  calibration: {
    title: "Calibration",
    load: async () => new (await import("./calibrationpanel.js")).CalibrationPanel(wall.tiles),
  },
  signals: {
    title: "Signals",
    load: async () =>
      (signals = new (await import("./signalspanel.js")).SignalsPanel((shown) => connection.askSignals(shown))),
  },
  episodes: {
    title: "Episodes",
    load: async () => (episodes = new (await import("./episodespanel.js")).EpisodesPanel()),
  },
});
const liveStatus = new LiveStatus(showLiveStatus);
/** @type {string | null} the dataset that is shown instead of the live rig */
let dataset = datasetOf(location.search);

const connection = new Connection({
  onState: showConnection,
  onHello: welcome,
  onStatus: showStatus,
  onImage: (image, credit) => wall.accept(image, credit),
  onPixel: (answer) => hover.answer(answer),
  onGeometry: (geometry) => {
    geometries.set(geometry.stream, geometry);
    mixing.look();
    wipeLine.place();
    cloud.redraw();
  },
  onMeasure: (measure) => aids.measured(measure),
  onSignals: (news) => signals?.answer(news),
  onProblem: showProblem,
});

/**
 * @param {import("./connection.js").ConnectionState} state
 * @param {string} text
 */
function showConnection(state, text) {
  const box = byId("connection", HTMLElement);
  if (state === "lost" && box.dataset.state === "live") {
    play("error");
  }
  setState(box, state);
  setText(box, text);
  recordBar.setLive(state === "live");
  episodeBar.setLive(state === "live");
  if (state === "live") {
    wall.reconnect();
    signals?.reconnected();
  } else {
    hover.hide();
  }
  showTiles();
}

/** @param {Hello} hello */
function welcome(hello) {
  const own = document.querySelector("meta[name=depthrig-version]")?.getAttribute("content") ?? "";
  const isOther = hello.version !== own || hello.protocol !== PROTOCOL;
  byId("version-note", HTMLElement).hidden = !isOther;
  const versions = `This page is of depthrig ${own}, the daemon of ${hello.version}.`;
  const protocols = `This page speaks protocol ${PROTOCOL}, the daemon ${hello.protocol}.`;
  setText(byId("version-text", HTMLElement), hello.version === own ? protocols : versions);
  setText(byId("rig", HTMLElement), hello.rig);
  const shown = hello.dataset ?? null;
  document.title = `${shown ?? hello.rig}${hello.is_replay ? " (replay)" : ""} · depthrig`;
  replayBar.show(hello.is_replay, shown);
}

/** @param {Status} next */
function showStatus(next) {
  soundForCameras(next);
  status = next;
  wall.build(shownCameras(next));
  cloud.update(next);
  for (const camera of shownCameras(next)) {
    for (const stream of camera.streams) {
      const tile = wall.tiles.get(stream.id);
      if (tile !== undefined) {
        tile.stream = stream;
      }
    }
  }
  if (dataset === null) {
    showLiveStatus(next);
  }
  replayBar.update(next.replay);
  setText(byId("preparing", HTMLElement), preparingText(next));
  const { sets } = next;
  setText(byId("sets", HTMLElement), sets.sent === 0 ? "" : `${sets.sent} sets, ${sets.incomplete} incomplete`);
}

/** @param {Status} next of the live rig, whatever the wall shows */
function showLiveStatus(next) {
  recordBar.update(next);
  panels.update(next);
}

/** @param {Status} next */
function preparingText(next) {
  const { preparing } = next;
  if (!preparing) {
    return "";
  }
  return preparing.error ?? `The simulated scenes are rendered: ${Math.floor(preparing.share * 100)} %`;
}

/** @param {Status} next */
function soundForCameras(next) {
  const shown = status === null ? [] : shownCameras(status);
  for (const camera of shownCameras(next)) {
    const before = shown.find(({ name }) => name === camera.name);
    const hasFailed = camera.state === "failed" || camera.state === "reconnecting";
    if (before?.state === "streaming" && hasFailed) {
      play("error");
      announce(`Camera ${camera.name} failed: ${camera.message ?? camera.state}`);
    }
  }
}

/** @param {string} message */
function showProblem(message) {
  const box = byId("problem", HTMLElement);
  setText(box, message);
  setTimeout(() => box.textContent === message && setText(box, ""), PROBLEM_MS);
}

function showTiles() {
  const now = performance.now();
  if (document.hidden || status === null) {
    return;
  }
  range.follow(cloud.isOpen ? cloud.sources : wall.tiles.values(), now);
  cloud.tick(now);
  const facts = {
    cameras: shownCameras(status),
    isLive: connection.isLive,
    isReplay: replayBar.isShown,
    isPaused: replayBar.isShown && replayBar.isWaiting,
    fastestHz: replayBar.isShown ? replayBar.fastestHz : Infinity,
    preparing: preparingText(status),
  };
  labels.show(facts, now);
}

async function loadRecordings() {
  const { Recordings } = await import("./recordings.js");
  recordings ??= new Recordings(watchDataset);
  recordings.setWatched(dataset);
  return recordings;
}

/**
 * Shows a dataset on the wall, or the live rig.
 *
 * @param {string | null} name
 */
function watchDataset(name) {
  if (name !== dataset) {
    history.pushState(null, "", addressOf(location.pathname, name));
    showDataset(name);
  }
}

/** @param {string | null} name */
function showDataset(name) {
  dataset = name;
  status = null;
  hover.hide();
  // The streams of a dataset have the names of the live ones: no image of one may be taken for the other.
  wall.clear();
  cloud.clear();
  geometries.clear();
  recordings?.setWatched(name);
  recordBar.setLiveRig(name === null);
  replayBar.show(name !== null, name);
  connection.open(takeToken(), name);
  liveStatus.follow(name !== null);
  announce(name === null ? "Live" : `Replay of ${name}`);
}

/** One step back: from the enlarged image, the panel, the dataset. */
function goBack() {
  if (cloud.isOpen) {
    cloud.close();
  } else if (wall.enlarged !== null) {
    wall.enlarge(null);
  } else if (panels.isOpen) {
    panels.close();
  } else if (dataset !== null) {
    watchDataset(null);
  }
}

/** @param {import("./keys.js").KeyAction} action */
function act(action) {
  switch (action.action) {
    case "toggleRecord":
      return recordBar.toggle();
    case "note":
      return recordBar.focusNotes();
    case "back":
      return goBack();
    case "panel":
      return panels.toggle(action.panel);
    case "redo":
      return takes.redo();
    case "bad":
      return takes.bad();
    case "good":
      return takes.good();
    case "mark":
      return void takes.mark();
    case "episode":
      return episodeBar.toggle();
    case "success":
    case "failure":
      return episodeBar.judge(action.action);
    case "discard":
      return episodeBar.discard();
    case "task":
      return episodeBar.focusTask();
    case "help":
      return byId("help", HTMLDialogElement).showModal();
    case "cloud":
      return cloud.toggle();
    case "aids":
      return showAids();
    case "reference":
      return void showReference();
    case "camera":
      cloud.close();
      return wall.enlargeCamera(action.n) ? undefined : showProblem(`There is no camera ${action.n}.`);
    case "enlarge": {
      const tile = focusedTile();
      return tile === undefined ? undefined : wall.enlarge(tile);
    }
    case "playPause":
      return replayBar.isShown ? replayBar.togglePause() : showProblem("P pauses a replay, and this is none.");
    case "step":
      return replayBar.isShown ? replayBar.step(action.sets) : undefined;
  }
}

/** The tile that has the focus. */
function focusedTile() {
  const focused = document.activeElement;
  const id = focused instanceof HTMLElement ? focused.dataset.stream : undefined;
  return wall.tiles.get(id ?? "");
}

/** Aids go with an enlarged image: without one, the tile that has the focus or the first is enlarged. */
function showAids() {
  if (cloud.isOpen) {
    showProblem("Aids go with an enlarged image; Esc closes the 3-D view.");
    return;
  }
  if (wall.enlarged !== null) {
    aids.toggle();
    return;
  }
  const tile = focusedTile() ?? [...wall.tiles.values()][0];
  if (tile === undefined) {
    showProblem("Aids go with an image, and none is shown yet.");
    return;
  }
  wall.enlarge(tile);
  if (!aids.isOpen) {
    aids.toggle();
  }
}

/** A reference goes with an enlarged image of colour or infrared, too. */
async function showReference() {
  if (cloud.isOpen) {
    showProblem("A reference goes with an enlarged image; Esc closes the 3-D view.");
    return;
  }
  if (wall.enlarged === null) {
    const tile = focusedTile();
    wall.enlarge(tile?.isDepth === false ? tile : ([...wall.tiles.values()].find(({ isDepth }) => !isDepth) ?? null));
  }
  if (wall.enlarged === null || wall.enlarged.isDepth) {
    showProblem("A reference is kept of colour and infrared images.");
    return;
  }
  try {
    const { Reference } = await import("./reference.js");
    reference ??= new Reference();
    Object.assign(debug, { reference });
    reference.enlarged(wall.enlarged);
    reference.toggle();
  } catch {
    showProblem("The reference was not loaded: the daemon does not answer.");
  }
}

function setUpKeys() {
  document.addEventListener("keydown", (event) => {
    // Whatever has the focus: nobody expects a recording to start after Esc.
    if (event.key === "Escape" && recordBar.cancelCountdown()) {
      event.preventDefault();
      return;
    }
    const target = keyTarget(event.target);
    if (event.key === "Escape" && target.isText && event.target instanceof HTMLElement) {
      event.target.blur();
      return;
    }
    const action = actionOf(event, target);
    if (action !== null) {
      // Space would scroll, and N would be typed into the field that it opens.
      event.preventDefault();
      act(action);
    }
  });
}

releaseFocusAfterClicks();
setUpKeys();
setUpSound();
byId("show-help", HTMLButtonElement).addEventListener("click", () => byId("help", HTMLDialogElement).showModal());
byId("close-help", HTMLButtonElement).addEventListener("click", () => byId("help", HTMLDialogElement).close());
hasReference.addEventListener("click", () => void showReference());
byId("reload", HTMLButtonElement).addEventListener("click", () => location.reload());
// A new address in the same tab changes the fragment only, and loads nothing.
addEventListener("hashchange", () => connection.open(takeToken(), dataset));
addEventListener("popstate", () => {
  const named = datasetOf(location.search);
  if (named !== dataset) {
    showDataset(named);
  }
});

setInterval(showTiles, STATE_EVERY_MS);
if (dataset === null) {
  connection.open(takeToken(), null);
} else {
  showDataset(dataset);
}
