/** Meshes that are drawn at once: each call takes the main thread as long as any other, whatever it draws. */

import { BufferAttribute, BufferGeometry, Mesh } from "../vendor/three.js";

/** One mesh in the place of several of one material, without what textures need. */
export function joined(...meshes) {
  const parts = meshes.map((mesh) => {
    mesh.updateMatrix();
    return mesh.geometry.clone().applyMatrix4(mesh.matrix);
  });
  const geometry = new BufferGeometry();
  for (const name of ["position", "normal"]) {
    const values = parts.flatMap((part) => [...part.getAttribute(name).array]);
    geometry.setAttribute(name, new BufferAttribute(new Float32Array(values), 3));
  }
  let before = 0;
  const index = [];
  for (const part of parts) {
    for (const each of part.index.array) index.push(before + each);
    before += part.getAttribute("position").count;
    part.dispose();
  }
  geometry.setIndex(index);
  for (const { geometry: own } of meshes) own.dispose();
  return new Mesh(geometry, meshes[0].material);
}
