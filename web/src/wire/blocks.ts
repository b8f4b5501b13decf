/**
 * Decoder of float32 arrays in the block format of docs/reference/block-format.md.
 *
 * The checksums of zstd frames are not verified: the transport has checked the bytes.
 */
import { decompress } from "fzstd";

const MAGIC = 0x3142524d; // "MRB1", read as a little-endian integer
const MOST_ELEMENTS = 1 << 26;
const MOST_TILE_BYTES = 1 << 24;
const RAW = 0;
const DIFFERENCES = 1;
const QUATERNIONS = 2;
const WIDTH = 4;

export interface DecodedArray {
  shape: number[];
  values: Float32Array;
}

interface Tile {
  frames: number;
  columns: number;
}

/** Decode an array. Throws a RangeError that says what is wrong with the bytes. */
export function decodeBlocks(data: Uint8Array): DecodedArray {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  if (data.length < 16 || view.getUint32(0, true) !== MAGIC) throw new RangeError("these bytes are not a block-encoded array");
  const dtype = String.fromCharCode(...data.subarray(4, 7));
  if (dtype !== "<f4") throw new RangeError(`the array has the dtype ${dtype}; only <f4 can be shown`);
  const axes = data[7]!;
  if (axes > 8 || data.length < 20 + 8 * axes) throw new RangeError("the header of the array is malformed");
  const shape = Array.from({ length: axes }, (_, axis) => Number(view.getBigUint64(8 + 8 * axis, true)));
  const frames = shape[0] ?? 1;
  const columns = shape.slice(1).reduce((product, length) => product * length, 1);
  if (!(frames * columns <= MOST_ELEMENTS)) throw new RangeError("the array is too large for a browser");
  const table = 16 + 8 * axes;
  const blockFrames = view.getUint32(table - 8, true);
  const groupColumns = view.getUint32(table - 4, true);
  if (blockFrames < 1 || groupColumns < 1) throw new RangeError("the header declares tiles without frames or columns");
  if (Math.min(blockFrames, frames) * Math.min(groupColumns, columns) * WIDTH > MOST_TILE_BYTES) {
    throw new RangeError("the header declares tiles that are too large");
  }
  const groups = Math.ceil(columns / groupColumns);
  const count = Math.ceil(frames / blockFrames) * groups;
  const end = table + 4 * count;
  if (end + 4 > data.length) throw new RangeError("the data ends inside the index of its tiles");
  if (crc32(data.subarray(0, end)) !== view.getUint32(end, true)) throw new RangeError("the checksum of the header is wrong");

  let start = end + 4;
  let total = start;
  for (let tile = 0; tile < count; tile++) total += view.getUint32(table + 4 * tile, true);
  if (total !== data.length) throw new RangeError(`the data has ${data.length} bytes, but its index requires ${total}`);
  const values = new Float32Array(frames * columns);
  for (let tile = 0; tile < count; tile++) {
    const stop = start + view.getUint32(table + 4 * tile, true);
    const firstFrame = Math.floor(tile / groups) * blockFrames;
    const firstColumn = (tile % groups) * groupColumns;
    const size = {
      frames: Math.min(blockFrames, frames - firstFrame),
      columns: Math.min(groupColumns, columns - firstColumn),
    };
    const rows = unpack(data.subarray(start, stop), size);
    for (let frame = 0; frame < size.frames; frame++) {
      const row = rows.subarray(frame * size.columns, (frame + 1) * size.columns);
      values.set(row, (firstFrame + frame) * columns + firstColumn);
    }
    start = stop;
  }
  return { shape, values };
}

/** Return the elements of a tile, frame by frame. */
function unpack(packed: Uint8Array, size: Tile): Float32Array {
  const most = 2 + 2 * size.columns + size.frames * size.columns * WIDTH;
  const declared = contentSize(packed);
  if (declared < 1 || declared > most) throw new RangeError(`a tile declares ${declared} bytes, which is not possible`);
  const content = decompress(packed, new Uint8Array(declared));
  if (content.length !== declared) throw new RangeError("a tile is shorter than it declares");
  const body = new Sections(content.subarray(1));
  switch (content[0]) {
    case RAW: {
      const bytes = body.take(size.frames * size.columns * WIDTH);
      body.requireEnd();
      return new Float32Array(bytes.slice().buffer);
    }
    case DIFFERENCES: {
      const channels = readChannels(body, size.columns, size.frames);
      body.requireEnd();
      return transposed(channels, size, Array.from({ length: size.columns }, (_, column) => column));
    }
    case QUATERNIONS:
      return restoreQuaternions(body, size);
    default:
      throw new RangeError(`a tile has the unknown encoding ${content[0]}`);
  }
}

/** Return the content size that a zstd frame states (RFC 8878, section 3.1.1.1); 0 if it states none. */
function contentSize(frame: Uint8Array): number {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  if (frame.length < 14 || view.getUint32(0, true) !== 0xfd2fb528) throw new RangeError("a tile is not a zstd frame");
  const descriptor = frame[4]!;
  const single = (descriptor & 0x20) !== 0;
  const at = 5 + (single ? 0 : 1) + [0, 1, 2, 4][descriptor & 3]!;
  switch (descriptor >> 6) {
    case 0: return single ? frame[at]! : 0;
    case 1: return view.getUint16(at, true) + 256;
    case 2: return view.getUint32(at, true);
    default: return Number(view.getBigUint64(at, true));
  }
}

class Sections {
  private position = 0;

  constructor(private readonly bytes: Uint8Array) {}

  take(size: number): Uint8Array {
    const end = this.position + size;
    if (end > this.bytes.length) throw new RangeError("a tile ends too early");
    const taken = this.bytes.subarray(this.position, end);
    this.position = end;
    return taken;
  }

  requireEnd(): void {
    if (this.position !== this.bytes.length) throw new RangeError("a tile has bytes after its last section");
  }
}

/** Return folded integers, channel by channel, from their four byte planes. */
function readPlanes(body: Sections, channels: number, frames: number): Int32Array {
  const count = channels * frames;
  const planes = [0, 1, 2, 3].map(() => body.take(count));
  const [lowest, second, third, highest] = planes as [Uint8Array, Uint8Array, Uint8Array, Uint8Array];
  const integers = new Int32Array(count);
  for (let index = 0; index < count; index++) {
    const folded = lowest[index]! | (second[index]! << 8) | (third[index]! << 16) | (highest[index]! << 24);
    integers[index] = (folded >>> 1) ^ -(folded & 1);
  }
  return integers;
}

/** Return the ordered integers of a channel section, channel by channel. */
function readChannels(body: Sections, channels: number, frames: number): Int32Array {
  const orders = body.take(channels);
  const integers = readPlanes(body, channels, frames);
  for (let channel = 0; channel < channels; channel++) {
    const values = integers.subarray(channel * frames, (channel + 1) * frames);
    for (let order = orders[channel]!; order > 0; order--) {
      for (let frame = order; frame < frames; frame++) values[frame] = (values[frame]! + values[frame - 1]!) | 0;
    }
  }
  return integers;
}

/** Map integers that sort like floats to the bits of these floats; the function is its own inverse. */
const ordered = (bits: number): number => (bits < 0 ? bits ^ 0x7fffffff : bits);

/** Write channels as columns `places` of a tile. */
function transposed(channels: Int32Array, size: Tile, places: number[]): Float32Array {
  const bits = new Int32Array(size.frames * size.columns);
  places.forEach((column, channel) => {
    for (let frame = 0; frame < size.frames; frame++) {
      bits[frame * size.columns + column] = ordered(channels[channel * size.frames + frame]!);
    }
  });
  return new Float32Array(bits.buffer);
}

function restoreQuaternions(body: Sections, size: Tile): Float32Array {
  const lead = body.take(1)[0]!;
  const quaternions = Math.floor((size.columns - lead) / 4);
  if (quaternions < 1) throw new RangeError("a tile of quaternions has fewer columns than one quaternion needs");
  const choices = body.take(quaternions);
  if (choices.some((choice) => choice > 7)) throw new RangeError("a tile of quaternions has an unknown code for the omitted component");
  const predicted = new Set(Array.from(choices, (choice, index) => lead + 4 * index + (choice & 3)));
  const others = Array.from({ length: size.columns }, (_, column) => column).filter((column) => !predicted.has(column));
  const values = transposed(readChannels(body, others.length, size.frames), size, others);
  const residuals = readPlanes(body, quaternions, size.frames);
  body.requireEnd();
  const bits = new Int32Array(values.buffer);
  const scratch = new Float32Array(1);
  const scratchBits = new Int32Array(scratch.buffer);
  choices.forEach((choice, index) => {
    const start = lead + 4 * index;
    const column = start + (choice & 3);
    const [first, second, third] = [0, 1, 2, 3].filter((one) => one !== (choice & 3)) as [number, number, number];
    for (let frame = 0; frame < size.frames; frame++) {
      const row = frame * size.columns;
      const a = values[row + start + first]!;
      const b = values[row + start + second]!;
      const c = values[row + start + third]!;
      const magnitude = Math.fround(Math.sqrt(Math.max(1 - a * a - b * b - c * c, 0)));
      scratch[0] = choice & 4 ? -magnitude : magnitude;
      bits[row + column] = ordered((ordered(scratchBits[0]!) + residuals[index * size.frames + frame]!) | 0);
    }
  });
  return values;
}

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let remainder = byte;
  for (let bit = 0; bit < 8; bit++) remainder = remainder & 1 ? 0xedb88320 ^ (remainder >>> 1) : remainder >>> 1;
  return remainder;
});

function crc32(bytes: Uint8Array): number {
  let crc = 0xffffffff;
  for (const byte of bytes) crc = CRC_TABLE[(crc ^ byte) & 0xff]! ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}
