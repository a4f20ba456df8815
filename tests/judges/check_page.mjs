// The page of `capture4d export --format html` in Chromium, from disk: nothing is requested, and every control works.
//   NODE_MODULES=DIR node check_page.mjs PAGE.html FRAMES [PICTURE.png]
// Exit code 1 on a mismatch.
import {mkdtempSync} from 'node:fs';
import {createRequire} from 'node:module';
import {tmpdir} from 'node:os';
import {join, resolve} from 'node:path';

const {chromium} = createRequire(join(resolve(process.env.NODE_MODULES), 'x.js'))('playwright-core');
const [page_path, frames, picture] = process.argv.slice(2);
const faults = [], requests = [], messages = [];
const fault = text => { faults.push(text); console.log(`MISMATCH ${text}`); };
const context = await chromium.launchPersistentContext(mkdtempSync(join(tmpdir(), 'page-')), {
  executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', headless: true, viewport: {width: 640, height: 640},
  args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist', '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync'],
});
const page = context.pages()[0] ?? await context.newPage();
page.setDefaultTimeout(180_000); // a busy machine draws in software
page.on('request', request => { if (!/^(file|blob|data):/.test(request.url())) requests.push(request.url()); });
page.on('console', m => { if (['error', 'warning'].includes(m.type()) && !/GPU stall|GL Driver/.test(m.text())) messages.push(m.text()); });
page.on('pageerror', error => messages.push(String(error)));
await page.goto(`file://${resolve(page_path)}`);
const until = async (what, said) => { // the page's policy forbids what waitForFunction does
  for (let tries = 0; tries < 600; tries++) { if (await page.evaluate(what)) return; await page.waitForTimeout(200); }
  fault(said);
};
await until(() => window.ready === true, 'the page did not get ready');
if (!faults.length) {
  const last = Number(frames) - 1;
  if (await page.evaluate(() => Number(document.getElementById('frame').max)) !== last) fault(`no slider over ${frames} frames`);
  const texel = () => { // what of the map is shown
    const map = window.viewer.map(); if (!map || !map.image) return null;
    const canvas = document.createElement('canvas'); canvas.width = canvas.height = 16;
    const context = canvas.getContext('2d'); context.drawImage(map.image, 0, 0, 16, 16);
    return [...context.getImageData(0, 0, 16, 16).data].join();
  };
  const slide = async frame => {
    await page.evaluate(f => { const s = document.getElementById('frame'); s.value = f; s.dispatchEvent(new Event('input')); }, frame);
    await page.waitForTimeout(1500);
    return page.evaluate(texel);
  };
  const first = await slide(0), middle = await slide(Math.floor(last / 2));
  if (!first || !middle || first === middle) fault('the map does not change with the frames');
  if (!(await page.evaluate(() => document.getElementById('label').textContent)).startsWith('frame ')) fault('no frame number');
  if (picture) await page.screenshot({path: picture});
  await page.click('#wrinkles');
  if (await page.evaluate(() => window.viewer.map()) !== null) fault('wrinkles do not go off');
  if (picture) await page.screenshot({path: picture.replace(/\.png$/, '-without.png')});
  await page.click('#wrinkles');
  await page.evaluate(() => { window.before = window.viewer.at(); });
  await page.click('#play');
  await until(() => window.viewer.at() !== window.before, 'it does not play');
}
if (requests.length) fault(`asked the network for ${requests[0]}`);
if (messages.length) fault(`console: ${messages[0]}`);
await context.close();
console.log(faults.length ? `${faults.length} mismatch(es)` : 'OK');
process.exit(faults.length ? 1 : 0);
