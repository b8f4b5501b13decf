import { describe, expect, it } from "vitest";
import { Clip, clipOf, skeletonOf } from "../src/motion/clip";
import { findContacts } from "../src/motion/contacts";
import { Kinematics } from "../src/motion/kinematics";
import { type PackedMotion, unpackMotion, unpackPage } from "../src/motion/packed";
import { type HierarchyDocument, type MappingDocument, Skeleton } from "../src/motion/skeleton";
import { Actor } from "../src/scene/actor";
import { shapeBody } from "../src/scene/body";
import { decodeMessagePack } from "../src/wire/messagepack";
import { bytesOf, floatsOf, INDEX, jsonOf } from "./cases";

const TOLERANCE_M = 1e-5;
/** Greatest distance of a joint from its place if the rotations of all its parents are rounded. */
const PACKED_TOLERANCE_M = 1e-3;

function loadCase(name: string): Clip {
  const document = decodeMessagePack(bytesOf(`${name}.msgpack`));
  expect(skeletonOf(document)).toEqual({ item: "skeleton_x", revision: 3 });
  const skeleton = new Skeleton(jsonOf<HierarchyDocument>(`${name}.hierarchy.json`), jsonOf<MappingDocument>(`${name}.mapping.json`));
  return clipOf(name, document, skeleton);
}

describe.each(INDEX.clips)("the clip %s", (name) => {
  it("has joints and end sites where the server computes them", () => {
    const clip = loadCase(name);
    const expected = floatsOf(`${name}.positions`);
    const kinematics = new Kinematics(clip);
    const width = 3 * clip.skeleton.pointCount;
    expect(expected.length).toBe(clip.frames * width);
    let largest = 0;
    for (let frame = 0; frame < clip.frames; frame++) {
      kinematics.update(frame).forEach((value, at) => (largest = Math.max(largest, Math.abs(value - expected[frame * width + at]!))));
    }
    expect(largest).toBeLessThan(TOLERANCE_M);
  });

  it("is the same after it was packed for a page without a server, but for rounding", async () => {
    const clip = loadCase(name);
    const packed = await unpackMotion(jsonOf<PackedMotion>(`${name}.packed.json`));
    expect([packed.name, packed.frames, packed.frameRate]).toEqual([name, clip.frames, clip.frameRate]);
    const [exact, rounded] = [new Kinematics(clip), new Kinematics(packed)];
    for (let frame = 0; frame < clip.frames; frame++) {
      const places = exact.update(frame);
      rounded.update(frame).forEach((value, at) => expect(Math.abs(value - places[at]!)).toBeLessThan(PACKED_TOLERANCE_M));
    }
    expect(packed.skeleton.sides).toEqual(clip.skeleton.sides);
    expect(packed.skeleton.feet).toEqual(clip.skeleton.feet);
  });

  it("faces where the server computes it, also without a mapping", () => {
    const clip = loadCase(name);
    const unmapped = clipOf(name, decodeMessagePack(bytesOf(`${name}.msgpack`)), new Skeleton(jsonOf<HierarchyDocument>(`${name}.hierarchy.json`)));
    const expected = floatsOf(`${name}.facing`);
    for (const actor of [new Actor(clip), new Actor(unmapped)]) {
      for (let frame = 0; frame < clip.frames; frame += 7) {
        actor.seek(frame / clip.frameRate);
        const angle = (actor.heading * Math.PI) / 180;
        expect(Math.sin(angle)).toBeCloseTo(expected[2 * frame]!, 4);
        expect(Math.cos(angle)).toBeCloseTo(expected[2 * frame + 1]!, 4);
      }
    }
  });

  it("touches the ground in the frames in which the server finds contacts", () => {
    const clip = loadCase(name);
    const expected = bytesOf(`${name}.contacts`);
    const found = findContacts(clip);
    const toes = ["LeftToeBase", "RightToeBase"].map((toe) => clip.skeleton.feet.indexOf(clip.skeleton.names.indexOf(toe)));
    toes.forEach((toe, index) => {
      const wanted = expected.subarray(index * clip.frames, (index + 1) * clip.frames);
      const different = wanted.filter((flag, frame) => flag !== found[toe]![frame]).length;
      expect(different).toBeLessThanOrEqual(1); // speeds at the limit, which rounding decides
    });
    if (name === "gait") expect(expected.some((flag) => flag === 1)).toBe(true);
  });
});

describe("the body of a skeleton", () => {
  it("has sides by the mapping, and a limb for each bone that has a length", () => {
    const { skeleton } = loadCase("gait");
    const side = (joint: string) => skeleton.sides[skeleton.names.indexOf(joint)];
    expect([side("LeftFoot"), side("RightFoot"), side("Hips")]).toEqual(["left", "right", "centre"]);
    const body = shapeBody(skeleton);
    expect(body.height).toBeGreaterThan(1.5);
    expect(body.limbs.every((limb) => limb.radius > 0 && limb.radius < 0.12)).toBe(true);
  });

  it("is derived for a skeleton with one joint, or with bones without length", () => {
    const one = new Skeleton({ joints: [{ name: "Wurzel", parent: -1, offset: [0, 1, 0] }] });
    expect(shapeBody(one).limbs).toEqual([]);
    const chain = new Skeleton({
      joints: [
        { name: "a", parent: -1, offset: [0, 1, 0] },
        { name: "b", parent: 0, offset: [0, 0.5, 0] },
        { name: "c", parent: 1, offset: [0, 0, 0] },
      ],
      end_sites: [{ joint: 2, offset: [0.2, 0, 0] }],
    });
    expect(shapeBody(chain).limbs.length).toBeGreaterThan(0);
    expect(chain.feet).toEqual([]);
  });
});

describe("a skeleton whose root carries the body through space", () => {
  const joints: HierarchyDocument["joints"] = [
    { name: "joint_Root", parent: -1, offset: [0, 0, 0] },
    { name: "Hips", parent: 0, offset: [0, 0.95, 0] },
    { name: "Spine", parent: 1, offset: [0, 0.5, 0] },
    { name: "LeftUpLeg", parent: 1, offset: [0.1, 0, 0] },
    { name: "LeftLeg", parent: 3, offset: [0, -0.45, 0] },
  ];

  it.each([["mapped", { joints: { left_hip: "LeftUpLeg" } }], ["not mapped", null]])("has no bone to its hips, %s", (_, mapping) => {
    const skeleton = new Skeleton({ joints }, mapping);
    expect(skeleton.hips).toBe(1);
    expect(shapeBody(skeleton).bones.map((bone) => bone.to)).toEqual([2, 3, 4]);
  });

  it("has hips in the middle if there is a joint between them and each leg", () => {
    const legs = ["Left", "Right"].flatMap((side, index) => [
      { name: `${side}Buttock`, parent: 1, offset: [index === 0 ? 0.05 : -0.05, 0, 0] as [number, number, number] },
      { name: `${side}Thigh`, parent: 3 + 2 * index, offset: [0, -0.1, 0] as [number, number, number] },
    ]);
    const skeleton = new Skeleton({ joints: [...joints.slice(0, 3), ...legs] }, { joints: { left_hip: "LeftThigh", right_hip: "RightThigh" } });
    expect([skeleton.hips, skeleton.across]).toEqual([1, [4, 6]]);
    expect(shapeBody(skeleton).bones.map((bone) => bone.to)).toEqual([2, 3, 4, 5, 6]);
  });

  it("is as high as its bones from foot to head, however the trunk is joined to the legs", () => {
    const body: HierarchyDocument["joints"] = [
      { name: "BoneRoot", parent: -1, offset: [0, 0, 0] },
      { name: "Hip", parent: 0, offset: [0, 1, 0] },
      { name: "Pelvis", parent: 1, offset: [0, 0, 0] },
      ...[1, -1].flatMap((side, index) => [
        { name: `${side === 1 ? "L" : "R"}_Thigh`, parent: 2, offset: [0.1 * side, 0, 0] as [number, number, number] },
        { name: `${side === 1 ? "L" : "R"}_Foot`, parent: 3 + 2 * index, offset: [0, -0.9, 0] as [number, number, number] },
      ]),
      { name: "Waist", parent: 1, offset: [0, 0.2, 0] },
      { name: "Head", parent: 7, offset: [0, 0.5, 0] },
    ];
    const mapping = { joints: { left_hip: "L_Thigh", right_hip: "R_Thigh", left_ankle: "L_Foot", right_ankle: "R_Foot", head: "Head" } };
    const shape = shapeBody(new Skeleton({ joints: body }, mapping));
    expect(shape.height).toBeCloseTo(1.7); // 0.1 + 0.9 + 0.2 + 0.5
    expect(shape.middle).toEqual([2]);
    const animal = body.map((joint) => (joint.name === "Head" ? { ...joint, offset: [0, 0, 0.5] as [number, number, number] } : joint));
    expect(shapeBody(new Skeleton({ joints: animal }, mapping)).middle).toEqual([2, 8]);
  });

  it("is looked at where its hips are", () => {
    const poses = new Float32Array(2 * (3 + 4 * joints.length));
    poses.forEach((_, at) => (poses[at] = at % (3 + 4 * joints.length) >= 3 && ((at % (3 + 4 * joints.length)) - 3) % 4 === 0 ? 1 : 0));
    const names = joints.map((joint) => joint.name);
    const moved = Float32Array.from([1, 0.95, 2, 5, 0.95, 6]);
    const actor = new Actor(new Clip("moved", new Skeleton({ joints }), 1, names, poses, ["Hips"], moved));
    actor.seek(1);
    expect(actor.centre(true)).toEqual([5, expect.any(Number), 6]);
    expect(actor.centre(false)).toEqual([1, expect.any(Number), 2]);
  });
});

describe("the data of a page without a server", () => {
  it("are refused if they are missing, of another form, or incomplete", async () => {
    await expect(unpackPage("\n")).rejects.toThrow("this page contains no motion");
    await expect(unpackPage('{"format": 2, "title": "x", "motions": []}')).rejects.toThrow("the format version 2, but this page reads version 1");
    const motion = jsonOf<PackedMotion>(`${INDEX.clips[0]!}.packed.json`);
    await expect(unpackMotion({ ...motion, frames: motion.frames + 1 })).rejects.toThrow("does not match the number of frames");
  });
});

it("looks at the whole body of a take whose origin is at the hips", () => {
  const clip = loadCase(INDEX.clips[0]!);
  const sunk = (metres: number) => {
    const poses = clip.poses.map((value, at) => (at % clip.width === 1 ? value - metres : value));
    return new Actor(new Clip("sunk", clip.skeleton, clip.frameRate, clip.joints, poses, clip.translatedJoints, clip.translations));
  };
  const height = (actor: Actor) => actor.centre(true)[1];
  const usual = height(sunk(0));
  expect(usual).toBeGreaterThan(0);
  expect(height(sunk(0.1))).toBe(usual); // feet that sink a little show by how much
  expect(usual - height(sunk(2))).toBeGreaterThan(1.5);
});
