// The canopies in 3D, on the terrain.
import {
  AmbientLight, Box3, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, Group, HemisphereLight, Mesh,
  MeshLambertMaterial, PerspectiveCamera, Raycaster, SRGBColorSpace, Scene, Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { colour, onScheme } from "./page.js";

/** Nodes of a raster as a surface about an origin; cells with an unknown corner are left out. */
function surface({ west, north, step, nx, lowest, z }, [x0, y0, z0]) {
  const ny = z.length / nx;
  const points = new Float32Array(z.length * 3);
  const faces = [];
  z.forEach((height, k) => {
    const [i, j] = [Math.floor(k / nx), k % nx];
    points.set([west + j * step - x0, lowest + (height ?? 0) / 100 - z0, -(north - i * step - y0)], 3 * k);
    if (i + 1 === ny || j + 1 === nx || [k, k + 1, k + nx, k + nx + 1].some((n) => z[n] === null)) return;
    faces.push(k, k + nx, k + 1, k + 1, k + nx, k + nx + 1);
  });
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(points, 3));
  geometry.setIndex(faces);
  geometry.computeVertexNormals();
  return geometry;
}

async function show(view, file, { terrain, rows, selected, whole, near }) {
  const renderer = new WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.outputColorSpace = SRGBColorSpace;
  renderer.setPixelRatio(Math.min(2, devicePixelRatio));
  const scene = new Scene();
  const camera = new PerspectiveCamera(40, 1, 0.5, 20000);
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.maxPolarAngle = 0.495 * Math.PI;
  controls.enableZoom = false; // until it has been clicked, so that the page scrolls
  const canvas = renderer.domElement;
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "The canopies in 3D; arrow keys move the view");
  canvas.addEventListener("focus", () => { controls.enableZoom = true; });
  canvas.addEventListener("blur", () => { controls.enableZoom = false; });
  controls.listenToKeyEvents(canvas);
  view.replaceChildren(canvas);

  const { scene: canopies } = await new GLTFLoader().parseAsync(file, "");
  scene.add(canopies);
  const root = canopies.children[0];
  const ground = new Mesh(surface(terrain, root.userData.origin ?? [0, 0, 0]), new MeshLambertMaterial({ side: DoubleSide }));
  scene.add(ground);
  const foliage = new MeshLambertMaterial({ flatShading: true });
  const chosen = new MeshLambertMaterial({ flatShading: true });
  const parts = new Map(rows.map((row) => [row.row_id, []]));
  for (const node of root.children) {
    node.traverse((part) => {
      if (!part.isMesh) return;
      part.material.dispose();
      part.material = foliage;
      part.userData.row = node.userData.row_id;
      parts.get(node.userData.row_id)?.push(part);
    });
  }
  const lights = new Group();
  const sun = new DirectionalLight("#fff4dc", 2.2);
  sun.position.set(-0.6, 1, 0.8);
  lights.add(sun, new HemisphereLight("#e8f0ff", "#8a7a5c", 1.1), new AmbientLight("#ffffff", 0.25));
  scene.add(lights);

  let waiting = 0;
  const draw = () => { waiting ||= requestAnimationFrame(() => { waiting = 0; renderer.render(scene, camera); }); };

  /** Look at something from the south, or from the side of a row. */
  function look(box, from) {
    if (box.isEmpty()) return;
    const middle = box.getCenter(new Vector3());
    const half = Math.tan((camera.fov * Math.PI) / 360) * Math.min(1, camera.aspect / 1.6);
    const reach = (0.36 * Math.max(box.getSize(new Vector3()).length(), 6)) / half;
    camera.position.copy(middle).addScaledVector(from.normalize(), reach);
    controls.target.copy(middle);
    controls.maxDistance = 2000;
    controls.update();
    draw();
  }
  const boxOf = (meshes) => meshes.reduce((box, mesh) => box.expandByObject(mesh), new Box3());
  const all = () => {
    const box = new Box3().expandByObject(canopies);
    return box.isEmpty() ? box.expandByObject(ground) : box;
  };
  const lookAtAll = () => look(all(), new Vector3(-0.25, 0.75, 1));
  function lookAtRow() {
    const box = boxOf(parts.get(selected.get().row_id));
    const size = box.getSize(new Vector3());
    look(box, size.x >= size.z ? new Vector3(-0.3, 0.45, 1) : new Vector3(-1, 0.45, 0.3));
  }
  whole.addEventListener("click", lookAtAll);
  near.addEventListener("click", lookAtRow);
  controls.addEventListener("change", draw);

  function paint() {
    scene.background = new Color(colour("sky"));
    foliage.color.set(colour("foliage"));
    chosen.color.set(colour("selected")).offsetHSL(0, 0, 0.1);
    ground.material.color.set(colour("soil"));
    draw();
  }
  function select(row) {
    for (const [id, meshes] of parts) meshes.forEach((mesh) => { mesh.material = id === row.row_id ? chosen : foliage; });
    draw();
  }
  const ray = new Raycaster();
  let down = [0, 0];
  canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return;
    const { left, top, width, height } = canvas.getBoundingClientRect();
    ray.setFromCamera(new Vector2((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height), camera);
    const [hit] = ray.intersectObject(canopies, true);
    const row = hit && rows.find((one) => one.row_id === hit.object.userData.row);
    if (row) selected.set(row);
  });

  new ResizeObserver(() => {
    const { clientWidth: width, clientHeight: height } = view;
    if (!width) return;
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    draw();
  }).observe(view);
  renderer.setSize(view.clientWidth, view.clientHeight);
  camera.aspect = view.clientWidth / view.clientHeight;
  camera.updateProjectionMatrix();
  onScheme(paint);
  selected.subscribe(select);
  paint();
  select(selected.get());
  lookAtAll();
  renderer.render(scene, camera);
}

globalThis.vinemapCanopies = show;
