// SPDX-License-Identifier: Apache-2.0
// Runs the script of a page that `vdbtrack measure` wrote, without a browser, and compares what it draws with the numbers
// it was given. Usage: node page_test.js index.html
'use strict';
const assert = require('assert');
const fs = require('fs');
const vm = require('vm');

const html = fs.readFileSync(process.argv[2], 'utf8');
const json = html.match(/<script type="application\/json" id="report">([^<]*)<\/script>/)[1];
const script = html.match(/<script>([^]*)<\/script>/)[1];
const main = { innerHTML: '' };
const document = {
  createElement: () => main,
  getElementById: id => ({ textContent: id === 'report' ? json : '' }),
  body: { append: element => assert.strictEqual(element, main) },
  querySelectorAll: () => []
};
vm.runInNewContext(script, { document });

const page = main.innerHTML;
const report = JSON.parse(json);
const count = text => page.split(text).length - 1;
for (const fault of ['undefined', 'NaN<', '>null', 'Infinity', '[object', 'NaN ', 'NaN"/']) {
  assert.ok(!page.includes(fault), `the page shows ${fault}: ${page.slice(page.indexOf(fault) - 200, page.indexOf(fault) + 50)}`);
}
// Every tag is closed, in order.
const open = [];
for (const [, close, name, rest] of page.matchAll(/<(\/?)([a-z0-9]+)((?:"[^"]*"|[^>"])*)>/gi)) {
  if (close) assert.strictEqual(open.pop(), name);
  else if (!rest.endsWith('/') && !['br', 'img', 'meta'].includes(name)) open.push(name);
}
assert.deepStrictEqual(open, []);

// A mark for every row with an error that converged; steps through every row of the front; a table line for every row.
const rows = report.sets.flatMap(s => s.rows);
const marked = rows.filter(r => r.converged && r.rmse > 1e-7);
assert.strictEqual(count('<title>'), marked.length);
const kFirst = 10;
assert.strictEqual(count('<tr class="'),
  report.sets.reduce((n, s) => n + Math.min(s.rows.length, kFirst) + (s.rows.length > kFirst ? s.rows.length : 0), 0));
assert.strictEqual(count('<svg'), report.sets.filter(s => s.rows.some(r => marked.includes(r))).length);
// Where a mark stands: right of every quicker one of its plot, above every one of less error.
for (const svg of page.match(/<svg[^]*?<\/svg>/g) || []) {
  const at = [...svg.matchAll(/translate\(([\d.]+) ([\d.]+)\)"[^>]*><title>[^<]*: ([\d.e+]+) ns, RMSE ([\d.e+-]+)</g)]
    .map(m => m.slice(1).map(Number));
  assert.strictEqual(at.length, svg.split('<title>').length - 1);
  for (const [x, y, time, error] of at) {
    assert.ok(x >= 76 && x <= 588 && y >= 48 && y <= 392, 'a mark outside its plot');
    for (const [x2, y2, time2, error2] of at) {
      assert.ok(!(time < time2) || x <= x2, 'a quicker mark further right');
      assert.ok(!(error < error2) || y >= y2, 'a smaller error further up');
    }
  }
  assert.ok(svg.split('class="grid"').length > 2, 'axes without ticks');
}
assert.strictEqual(count('class="advice"'), report.recommendation.length);
assert.strictEqual(page.includes('<h2 id="scattering">'), 'dual_scattering' in report);
const pictures = report.strips.reduce((n, s) => n + 4 * s.rows.length, 0) +
  (report.dual_scattering ? 2 * (report.dual_scattering.methods.length + 1) : 0);
assert.strictEqual(count('<img'), pictures);
assert.strictEqual(count('src="data:image/png;base64,'), pictures);
