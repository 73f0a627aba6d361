// The controls around the picture. They change a state and say that it changed.

const element = (id) => document.getElementById(id);
const STATE = { layer: 'rgb', compare: false, divider: 0.5, glass: 'real', pane: 'all' };

// The photograph that the address names, encoded or as somebody typed it.
function viewOfAddress(views) {
  const asked = [location.hash];
  try { asked.push(decodeURIComponent(location.hash)); } catch { /* A % that encodes nothing. */ }
  return views.find((view) => asked.includes(`#view=${view.name}`));
}

function makePanel(scene, navigation, changed) {
  const state = { ...STATE, reflectances: scene.panes.map((pane) => pane.reflectance) };
  const silver = scene.panes.map(() => 0);  // How far each pane is on its way from glass to a mirror.
  const divider = element('divider'), slider = element('reflectance');
  const body = document.body, reflects = scene.panes.length > 0 || Boolean(scene.mirrored);
  const chosen = () => scene.panes.map((_, k) => k).filter((k) => state.pane === 'all' || Number(state.pane) === k);
  const percent = (share) => `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;
  // The slider's middle is a third of all light, so that glass has room on it.
  const shareOf = (value) => value ** 1.6, valueOf = (share) => share ** (1 / 1.6);

  function show() {
    for (const button of document.querySelectorAll('[data-set]')) {
      const [key, value] = button.dataset.set.split('=');
      button.setAttribute('aria-pressed', String(state[key] === value));
    }
    element('compare').setAttribute('aria-pressed', String(state.compare));
    divider.hidden = !state.compare;
    divider.ariaValueNow = Math.round(100 * state.divider);
    divider.style.left = `${100 * state.divider}%`;
    const first = chosen()[0];
    if (first !== undefined) {
      slider.value = valueOf(state.reflectances[first]);
      element('share').textContent = percent(state.reflectances[first]);
    }
    element('dock').dataset.glass = state.glass;
    element('panes').value = state.pane;
    changed();
  }

  function set(key, value) {
    state[key] = value;
    show();
  }

  function divide(share) { set('divider', clamped(share, 0.02, 0.98)); }

  function standAt(view) {
    navigation.flyTo(view);
    element('photo').textContent = view.name;
    // By the whole address: in a frame of srcdoc, a fragment alone would lead to the page around it.
    location.replace(`${location.href.split('#')[0]}#view=${encodeURIComponent(view.name)}`);
    changed();
  }

  window.addEventListener('hashchange', () => {
    const view = viewOfAddress(scene.views);
    if (view && view.name !== element('photo').textContent) standAt(view);
  });

  // Shows one box or hides it, and hides the other.
  function toggle(box) {
    for (const id of ['help', 'embed']) element(id).hidden = id !== box || !element(id).hidden;
  }

  // Shows, selected, the tag of a frame with this page in it, and copies it where the browser lets it.
  function embed() {
    const code = document.querySelector('#embed textarea'), title = document.title.replace(/[&"<]/g, (c) => `&#${c.charCodeAt(0)};`);
    toggle('embed');
    if (location.protocol === 'file:') {
      code.value = 'This page lies on your disk, where others cannot see it: upload it to a web server, open it there, and press Embed again.';
      return;
    }
    code.value = `<iframe src="${location.href}" title="${title}" width="800" height="500" style="border: 0" allow="fullscreen"></iframe>`;
    code.select();
    navigator.clipboard?.writeText(code.value).catch(() => {});
  }

  const actions = {
    embed,
    compare: () => set('compare', !state.compare),
    before: () => standAt(navigation.neighbour(-1)),
    after: () => standAt(navigation.neighbour(1)),
    home: () => standAt(scene.views[scene.first]),
    full: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.()),
    help: () => toggle('help'),
    hide: () => body.classList.toggle('bare'),
  };
  const LAYER_KEYS = ['rgb', 'without_panes', 'reflection', 'strength'];
  const KEYS = {
    c: actions.compare, ArrowLeft: actions.before, ArrowRight: actions.after, Home: actions.home, r: actions.home,
    f: actions.full, '?': actions.help, h: actions.hide,
    Escape: () => toggle(null),
    g: () => set('glass', state.glass === 'none' ? 'real' : 'none'),
    m: () => set('glass', state.glass === 'mirror' ? 'real' : 'mirror'),
  };

  document.addEventListener('click', (event) => {
    const button = event.target.closest('button');
    if (!button) return;
    if (button.dataset.set) set(...button.dataset.set.split('='));
    if (button.dataset.do) actions[button.dataset.do]();
  });
  slider.addEventListener('input', () => {
    state.glass = 'real';
    for (const k of chosen()) state.reflectances[k] = clamped(shareOf(Number(slider.value)), 1e-4, 1 - 1e-4);
    show();
  });
  slider.addEventListener('dblclick', () => {
    for (const k of chosen()) state.reflectances[k] = scene.panes[k].reflectance;
    show();
  });
  divider.addEventListener('pointerdown', (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener('pointermove', (event) => {
    if (event.buttons) divide(event.clientX / window.innerWidth);
  });
  divider.addEventListener('keydown', ({ key }) => {
    if (key.startsWith('Arrow')) divide(state.divider + (key === 'ArrowLeft' || key === 'ArrowDown' ? -0.02 : 0.02));
  });

  const TURNS = { ArrowLeft: [0.05, 0], ArrowRight: [-0.05, 0], ArrowUp: [0, -0.05], ArrowDown: [0, 0.05] };  // radians
  const walking = new Set();
  window.addEventListener('blur', () => walking.clear());
  window.addEventListener('keyup', (event) => walking.delete(event.key.toLowerCase()));
  window.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || (event.repeat && !event.key.startsWith('Arrow'))) return;
    const own = event.target.matches('textarea') || (event.target.matches('[type=range], [role=slider], select') && event.key.length > 1);
    if (own && event.key !== 'Escape') return;  // A slider has use for arrows, not for letters.
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!reflects && ('cgm'.includes(key) || LAYER_KEYS[Number(key) - 1])) return;
    if (event.shiftKey && TURNS[key]) { navigation.still(); navigation.orbit(...TURNS[key]); }
    else if ('wasdqe'.includes(key)) { walking.add(key); navigation.still(); changed(); }
    else if (LAYER_KEYS[Number(key) - 1]) set('layer', LAYER_KEYS[Number(key) - 1]);
    else if (KEYS[key]) KEYS[key](); else return;
    body.classList.add('touched');
    event.preventDefault();
  });

  // Glass turns into a mirror in a second. Whether any pane still does.
  function turn(seconds) {
    const mirrors = state.glass === 'mirror' ? chosen() : [];
    let turning = false;
    silver.forEach((share, k) => {
      const end = mirrors.includes(k) ? 1 : 0;
      silver[k] = state.glass === 'none' ? 0 : share + clamped(end - share, -seconds, seconds);
      turning ||= silver[k] !== share;
    });
    if (turning) changed();
    return turning;
  }

  function walk(seconds) {
    if (!walking.size) return false;
    const step = 0.5 * navigation.sight() * seconds, held = (key) => (walking.has(key) ? step : 0);
    navigation.walk(held('w') - held('s'), held('d') - held('a'), held('e') - held('q'));
    return true;
  }

  // What draw() has to know of the state.
  function wanted() {
    const layers = state.compare ? [state.layer === 'without_panes' ? 'rgb' : state.layer, 'without_panes'] : [state.layer, state.layer];
    return {
      glass: scene.panes.map((_, k) => state.glass !== 'none' || !chosen().includes(k)),
      reflectances: state.reflectances.map((share, k) => share + EASE(silver[k]) * (1 - 1e-6 - share)),
      layers,
      divider: state.compare ? state.divider : 2,
    };
  }

  document.querySelector('[data-do=full]').hidden = !document.fullscreenEnabled;
  body.classList.toggle('panes', scene.panes.length > 0);
  body.classList.toggle('shiny', Boolean(scene.mirrored));
  if (scene.mirrored) document.querySelector('[data-set="layer=without_panes"]').textContent = 'Without reflections';
  if (scene.panes.length > 1) {
    const choice = (value, label) => `<option value="${value}">${label}</option>`;
    element('panes').innerHTML = choice('all', 'All') + scene.panes.map((pane, k) => choice(k, pane.label)).join('');
    element('panes').addEventListener('change', ({ target }) => set('pane', target.value));
    element('panes').parentElement.hidden = false;
  }
  show();
  return { wanted, walk, turn, set, state };
}
