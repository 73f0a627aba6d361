// Loads the scene and joins what shows it with what moves it.

function fail(text) {
  document.body.classList.add('failed');
  element('message').textContent = text;
}

async function start() {
  const scene = await loadedScene(), canvas = element('view'), renderer = makeRenderer(canvas, scene);
  let display = null;
  const changed = () => display?.changed();
  const navigation = makeNavigation(scene, changed), panel = makePanel(scene, navigation, changed);
  listenToPointers(canvas, navigation, () => document.body.classList.add('touched'));
  display = makeDisplay(canvas, scene, renderer, navigation, panel);
  canvas.addEventListener('webglcontextlost', () => fail('The browser has taken the picture away; load the page again.'));
  await display.begin();
  document.body.classList.toggle('plain', renderer.isSoftware);
  document.body.classList.add('ready');
  if (!renderer.isSoftware && !IS_STILL && !location.hash.includes('still')) navigation.sway();
  return { ...display, panel, navigation, scene };
}

window.glassplat = start();
window.glassplat.catch((error) => fail(`This scene cannot be shown: ${error.message}`));
