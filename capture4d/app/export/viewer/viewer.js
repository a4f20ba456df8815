// The page of `capture4d export --format html`. Bundled with three.js into viewer.min.js:
//   npm install three@0.187 esbuild
//   npx esbuild capture4d/app/export/viewer/viewer.js --bundle --minify --format=esm --target=es2022 \
//       --legal-comments=none --outfile=capture4d/app/export/viewer/viewer.min.js
import {
  AmbientLight, AnimationMixer, Box3, Color, DirectionalLight, LoopOnce, PerspectiveCamera, Scene, Texture, Vector3,
  WebGLRenderer,
} from 'three';
import {OrbitControls} from 'three/examples/jsm/controls/OrbitControls.js';
import {GLTFLoader} from 'three/examples/jsm/loaders/GLTFLoader.js';

const KEPT = 48, AHEAD = 12; // pictures that stay decoded, and those that are decoded before they are shown
const BAR = 48;
const take = JSON.parse(document.getElementById('take').textContent); // fps, frames, glb, maps
const bytes = text => Uint8Array.from(atob(text), character => character.charCodeAt(0));
const element = name => document.getElementById(name);
const slider = element('frame'), button = element('play'), wrinkles = element('wrinkles'), label = element('label');
const count = take.frames.length;

const renderer = new WebGLRenderer({antialias: true});
element('view').append(renderer.domElement);
const scene = new Scene(), camera = new PerspectiveCamera(30, 1, 0.01, 100);
const controls = new OrbitControls(camera, renderer.domElement);
const sun = new DirectionalLight(0xffffff, 3);
sun.position.set(-1, 0.9, 0.7);
scene.background = new Color(0xe8e8ea);
const fill = new DirectionalLight(0xffffff, 1);
fill.position.set(1, 0.2, 0.4);
scene.add(sun, fill, new AmbientLight(0xffffff, 0.6));

const gltf = await new GLTFLoader().parseAsync(bytes(take.glb).buffer, '');
scene.add(gltf.scene);
let mesh;
gltf.scene.traverse(each => { if (each.isMesh) mesh = each; });
mesh.frustumCulled = false;
const material = mesh.material, still = material.normalMap;
const mixer = new AnimationMixer(gltf.scene);
if (gltf.animations.length) {
  const action = mixer.clipAction(gltf.animations[0]);
  action.setLoop(LoopOnce).play();
  action.clampWhenFinished = true;
}

const decoded = new Map(); // frame to its texture, or the promise of one; the oldest first
function picture(frame) {
  if (!take.maps.length || decoded.has(frame)) return decoded.get(frame);
  const promise = createImageBitmap(new Blob([bytes(take.maps[frame])])).then(image => {
    const texture = still ? still.clone() : new Texture();
    texture.image = image;
    texture.needsUpdate = true;
    if (decoded.get(frame) === promise) decoded.set(frame, texture); else texture.dispose();
    if (frame === Math.floor(at)) dress();
  });
  decoded.set(frame, promise);
  for (const old of decoded.keys()) {
    if (decoded.size <= KEPT) break;
    const one = decoded.get(old);
    if (one.isTexture && one !== material.normalMap) { one.dispose(); decoded.delete(old); }
    else if (old !== frame) { decoded.delete(old); }
  }
  return promise;
}
function dress() {
  const found = wrinkles.checked ? picture(Math.floor(at)) : null;
  if (found && !found.isTexture) return; // it comes in a moment
  const map = wrinkles.checked ? found ?? still ?? null : null;
  if (material.normalMap === map) return;
  if (!material.normalMap !== !map) material.needsUpdate = true;
  material.normalMap = map;
}

let at = 0, playing = false, last = 0;
function show(frame) {
  at = Math.max(0, Math.min(frame, count - 1e-6));
  mixer.setTime(Math.min((take.frames[Math.min(Math.floor(at), count - 1)] - take.frames[0]) / take.fps, end));
  slider.value = Math.floor(at);
  label.textContent = `frame ${take.frames[Math.floor(at)]}`;
  dress();
  if (wrinkles.checked) for (let ahead = 1; ahead <= AHEAD && playing; ahead++) picture((Math.floor(at) + ahead) % count);
}
function play(on) {
  playing = on;
  button.textContent = on ? 'pause' : 'play';
  last = performance.now();
}
const end = gltf.animations.length ? gltf.animations[0].duration : 0;
slider.max = count - 1;
slider.oninput = () => { play(false); show(+slider.value); };
wrinkles.onchange = dress;
wrinkles.disabled = !still && !take.maps.length;
button.onclick = () => play(!playing);
addEventListener('keydown', event => {
  if (event.target === slider && event.key.startsWith('Arrow')) return;
  if (event.key === ' ' && event.target !== button) { play(!playing); event.preventDefault(); }
  else if (event.key === 'ArrowRight') show(Math.floor(at) + 1);
  else if (event.key === 'ArrowLeft') show(Math.floor(at) - 1);
});

function resize() {
  renderer.setPixelRatio(devicePixelRatio);
  renderer.setSize(innerWidth, innerHeight - BAR);
  camera.aspect = innerWidth / Math.max(1, innerHeight - BAR);
  camera.updateProjectionMatrix();
}
addEventListener('resize', resize);
resize();
const box = new Box3();
for (let each = 0; each < 8; each++) { // all of the motion is to be seen
  show(each / 8 * count);
  gltf.scene.updateMatrixWorld(true);
  box.union(new Box3().setFromObject(mesh, true));
}
show(0);
const centre = box.getCenter(new Vector3());
camera.position.copy(centre).add(new Vector3(0.35, 0.12, 1).multiplyScalar(1.9 * box.getSize(new Vector3()).length()));
controls.target.copy(centre);
controls.update();
renderer.setAnimationLoop(now => {
  if (playing) {
    const next = at + (now - last) / 1000 * take.fps;
    last = now;
    show(next >= count ? 0 : next);
  }
  renderer.render(scene, camera);
});
window.viewer = {show, at: () => at, map: () => material.normalMap, mesh};
window.ready = true;
