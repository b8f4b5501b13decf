/** Decoder of MessagePack, for the types that documents of Marey use. Binary data are views of the input, not copies. */

export type Tree = null | boolean | number | string | Uint8Array | Tree[] | { [key: string]: Tree };

const MOST_DEPTH = 64;

/** Decode one value that fills `bytes`. Throws a RangeError for truncated, longer or unsupported input. */
export function decodeMessagePack(bytes: Uint8Array): Tree {
  const reader = new Reader(bytes);
  const value = reader.value(0);
  if (reader.position !== bytes.length) throw new RangeError("the document has bytes after its end");
  return value;
}

class Reader {
  position = 0;
  private readonly view: DataView;
  private readonly text = new TextDecoder("utf-8", { fatal: true });

  constructor(private readonly bytes: Uint8Array) {
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  value(depth: number): Tree {
    if (depth > MOST_DEPTH) throw new RangeError("the document is nested too deeply");
    const type = this.uint(1);
    if (type < 0x80) return type;
    if (type < 0x90) return this.map(type & 0x0f, depth);
    if (type < 0xa0) return this.array(type & 0x0f, depth);
    if (type < 0xc0) return this.string(type & 0x1f);
    if (type >= 0xe0) return type - 0x100;
    switch (type) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: case 0xc5: case 0xc6: return this.take(this.uint(1 << (type - 0xc4)));
      case 0xca: return this.number(4, (at) => this.view.getFloat32(at));
      case 0xcb: return this.number(8, (at) => this.view.getFloat64(at));
      case 0xcc: case 0xcd: case 0xce: return this.uint(1 << (type - 0xcc));
      case 0xcf: return this.number(8, (at) => Number(this.view.getBigUint64(at)));
      case 0xd0: return this.number(1, (at) => this.view.getInt8(at));
      case 0xd1: return this.number(2, (at) => this.view.getInt16(at));
      case 0xd2: return this.number(4, (at) => this.view.getInt32(at));
      case 0xd3: return this.number(8, (at) => Number(this.view.getBigInt64(at)));
      case 0xd9: case 0xda: case 0xdb: return this.string(this.uint(1 << (type - 0xd9)));
      case 0xdc: case 0xdd: return this.array(this.uint(2 << (type - 0xdc)), depth);
      case 0xde: case 0xdf: return this.map(this.uint(2 << (type - 0xde)), depth);
      default: throw new RangeError(`the document has a value of the unsupported type 0x${type.toString(16)}`);
    }
  }

  private array(length: number, depth: number): Tree[] {
    const found: Tree[] = [];
    for (let index = 0; index < length; index++) found.push(this.value(depth + 1));
    return found;
  }

  private map(length: number, depth: number): { [key: string]: Tree } {
    const entries: [string, Tree][] = [];
    for (let index = 0; index < length; index++) {
      const key = this.value(depth + 1);
      if (typeof key !== "string") throw new RangeError("a key of the document is not a string");
      entries.push([key, this.value(depth + 1)]);
    }
    return Object.fromEntries(entries);
  }

  private string(length: number): string {
    return this.text.decode(this.take(length));
  }

  private uint(bytes: number): number {
    return this.number(bytes, (at) => {
      if (bytes === 1) return this.view.getUint8(at);
      return bytes === 2 ? this.view.getUint16(at) : this.view.getUint32(at);
    });
  }

  private number(bytes: number, read: (at: number) => number): number {
    this.take(bytes);
    return read(this.position - bytes);
  }

  private take(length: number): Uint8Array {
    const end = this.position + length;
    if (end > this.bytes.length) throw new RangeError("the document ends too early");
    const taken = this.bytes.subarray(this.position, end);
    this.position = end;
    return taken;
  }
}
