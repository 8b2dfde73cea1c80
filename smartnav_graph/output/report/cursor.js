(() => {
  const UNITS = 10000, NS = document.querySelector('svg').namespaceURI;
  const plots = [...document.querySelectorAll('svg.plot[data-x]')].map(svg => {
    const [lo, hi] = svg.dataset.x.split(' ').map(Number), [bottom, top, log] = svg.dataset.y.split(' ').map(Number);
    return {svg, lo, hi, bottom, top, log, height: svg.querySelector('svg.box').viewBox.baseVal.height};
  });
  const tracks = [...document.querySelectorAll('path[data-t]')];
  const bar = document.getElementById('cursor'), utc = Number(document.body.dataset.utcMs);
  let at = NaN, shown = null, pointer = 0;
  // Pieces of a path, each a list of [x, y] in drawing units.
  const pieces = path => path.points ??= path.getAttribute('d').split('M').filter(d => d).map(d => {
    const steps = (d.match(/-?\d+/g) || []).map(Number), at = [[steps[0], steps[1]]];
    if (d.includes('l')) for (let i = 2; i + 1 < steps.length; i += 2)
      at.push([at.at(-1)[0] + steps[i], at.at(-1)[1] + steps[i + 1]]);
    return at;
  });
  const lineAt = (path, x) => {
    for (const p of pieces(path)) {
      if (p.length < 2 || x < p[0][0] || x > p.at(-1)[0]) continue;
      let a = 0, b = p.length - 1;
      while (b - a > 1) { const m = (a + b) >> 1; if (p[m][0] <= x) a = m; else b = m; }
      return p[a][1] + (p[b][1] - p[a][1]) * (x - p[a][0]) / Math.max(p[b][0] - p[a][0], 1e-9);
    }
    return NaN;
  };
  const dotAt = (path, x, y) => {
    let best = NaN, least = Infinity;
    for (const [[a, b]] of pieces(path)) {
      const far = Math.abs(a - x) * 10 + Math.abs(b - y);
      if (Math.abs(a - x) < 60 && far < least) { least = far; best = b; }
    }
    return best;
  };
  const valueOf = (plot, y) => {
    const f = 1 - y / plot.height;
    if (plot.log) return (plot.bottom * (plot.top / plot.bottom) ** f).toPrecision(3);
    return (plot.bottom + f * (plot.top - plot.bottom)).toFixed(Math.max(0, 3 - Math.floor(Math.log10(plot.top - plot.bottom))));
  };
  const nameOf = (plot, path) => {
    const entries = plot.svg.closest('section').querySelectorAll('.legend li');
    const same = [...entries].find(li => li.querySelector('svg > *').getAttribute('class') === path.getAttribute('class'));
    return same ? same.textContent : '';
  };
  const values = plot => {
    const x = (at - plot.lo) / (plot.hi - plot.lo) * UNITS, found = [];
    for (const path of plot.svg.querySelectorAll('.box path.line:not(.limit), .box path.dots')) {
      const y = path.classList.contains('dots') ? dotAt(path, x, pointer * plot.height) : lineAt(path, x);
      if (Number.isFinite(y) && y >= 0 && y <= plot.height) found.push(`${nameOf(plot, path)} ${valueOf(plot, y)}`.trim());
    }
    const title = plot.svg.querySelector('.ty0');
    return `${title ? title.textContent : ''}: ${found.join(', ')}`;
  };
  const place = (svg, cls, make) => svg.querySelector('.' + cls) || svg.appendChild(make());
  const make = (name, cls) => () => { const e = document.createElementNS(NS, name); e.setAttribute('class', cls); return e; };
  const draw = () => {
    for (const plot of plots) {
      const f = (at - plot.lo) / (plot.hi - plot.lo), line = place(plot.svg, 'time-cursor', make('line', 'time-cursor'));
      for (const name of ['x1', 'x2']) line.setAttribute(name, `${100 * f}%`);
      line.setAttribute('y1', 0); line.setAttribute('y2', '100%');
      line.style.display = f >= 0 && f <= 1 ? '' : 'none';
    }
    for (const path of tracks) {
      const t = path.times ??= path.dataset.t.split(' ').map(Number), p = pieces(path)[0], box = path.closest('svg');
      let b = t.findIndex(x => x >= at);
      b = b < 0 ? t.length - 1 : Math.max(b, 1);
      const f = Math.min(Math.max((at - t[b - 1]) / Math.max(t[b] - t[b - 1], 1e-9), 0), 1);
      const [x, y] = [0, 1].map(i => p[b - 1][i] + f * (p[b][i] - p[b - 1][i]));
      const view = box.viewBox.baseVal, mark = place(box.parentElement, 'place-cursor', make('circle', 'place-cursor'));
      mark.setAttribute('cx', `${100 * x / view.width}%`); mark.setAttribute('cy', `${100 * y / view.height}%`);
      mark.setAttribute('r', 6);
    }
    const clock = Number.isFinite(utc) && document.body.dataset.utcMs
      ? ` · ${new Date(utc + 1000 * at).toISOString().slice(0, 22).replace('T', ' ')} UTC` : '';
    bar.textContent = `t = ${at.toFixed(2)} s${clock}${shown ? ` · ${values(shown)}` : ''}`;
    bar.hidden = false;
  };
  const inBox = (svg, event) => {
    const box = svg.querySelector('svg.box').getBoundingClientRect();
    pointer = Math.min(Math.max((event.clientY - box.top) / box.height, 0), 1);
    return [Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1), pointer];
  };
  for (const plot of plots) plot.svg.addEventListener('pointermove', event => {
    shown = plot; at = plot.lo + inBox(plot.svg, event)[0] * (plot.hi - plot.lo); draw();
  });
  for (const path of tracks) {
    const svg = path.closest('svg.plot');
    svg.addEventListener('pointermove', event => {
      const [x, y] = inBox(svg, event), view = path.closest('svg').viewBox.baseVal;
      const t = path.times ??= path.dataset.t.split(' ').map(Number);
      const far = pieces(path)[0].map(p => (p[0] - x * view.width) ** 2 + (p[1] - y * view.height) ** 2);
      shown = null; at = t[far.indexOf(Math.min(...far))]; draw();
    });
  }
  addEventListener('keydown', event => {
    if (bar.hidden || !plots.length) return;
    const step = (plots[0].hi - plots[0].lo) / 500;
    if (event.key === 'Escape') { bar.hidden = true; return; }
    if (event.key !== 'ArrowLeft' && event.key !== 'ArrowRight') return;
    at = Math.min(Math.max(at + (event.key === 'ArrowLeft' ? -step : step), plots[0].lo), plots[0].hi); draw();
  });
  addEventListener('beforeprint', () => document.querySelectorAll('details').forEach(one => { one.open = true; }));
})();
