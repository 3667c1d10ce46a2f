/* Masks (FORMAT.md 5.1, 5.2), as js/src/mask.js has them. */

typedef int i32;
typedef unsigned u32;
typedef unsigned char u8;

#define EXPORT(name) __attribute__((export_name(name)))

/*
 * Fill `implied` with 1 where a void sample of the parent heights touches a sample, else 0: rows of
 * n_cols samples, `stride` apart. above, below, left and right are the parent's lines beside each.
 */
EXPORT("imply")
void imply(i32 n_rows, i32 n_cols, const u8 *valid, i32 n_parent_cols, const i32 *above,
           const i32 *below, const i32 *left, const i32 *right, u8 *both, u8 *implied, i32 stride) {
  for (i32 r = 0; r < n_rows; r++) {
    const u8 *first = valid + above[r] * n_parent_cols, *second = valid + below[r] * n_parent_cols;
    for (i32 k = 0; k < n_parent_cols; k++) both[k] = first[k] & second[k];
    u8 *row = implied + r * stride;
    for (i32 c = 0; c < n_cols; c++) row[c] = (both[left[c]] & both[right[c]]) ^ 1;
  }
}

/* (x * rate) >> 16 for x of 22 bits and a rate of 16. */
static inline i32 scaled(i32 x, i32 rate) { return (i32)(((unsigned long long)x * (u32)rate) >> 16); }

/*
 * Decode the validity of all samples that are not implied (5.2). `valid` and `implied` have two
 * samples of margin on each side; data[n_data] and what follows stand for what is beyond the end.
 * Returns how many bytes were taken.
 */
EXPORT("decodeMask")
i32 decode_mask(i32 n_rows, i32 n_cols, i32 s, u8 *valid, const u8 *implied, i32 *cells,
                const i32 *rates, const u8 *data, i32 n_data) {
  u32 range = ~0u, code = 0;
  i32 position = 4;
  for (i32 i = 0; i < 4; i++) code = (code << 8) | (i < n_data ? data[i] : 0);
  for (i32 r = 0; r < n_rows; r++) {
    u8 *v = valid + (r + 2) * s + 2;
    const u8 *m = implied + (r + 2) * s + 2;
    for (i32 c = 0; c < n_cols; c++, v++, m++) {
      if (*m) continue;
      i32 near = 32 * v[-1] + 16 * v[-s] + 8 * v[-s - 1] + 4 * v[-s + 1] + 2 * v[-2] + v[-2 * s];
      i32 far = m[2] + m[s - 1] + m[s + 1] + m[2 * s];
      i32 *model = cells + (near * 3 + m[s] + m[1]) * 3 + (far < 2 ? far : 2);
      i32 cell = *model, count = cell & 255, rate = rates[count];
      i32 p = (i32)((u32)cell >> 8);
      u32 bound = (range >> 16) * (((u32)cell >> 14) | 1);
      i32 bit = code < bound;
      i32 change = bit ? scaled((1 << 22) - p, rate) : -scaled(p, rate);
      if (bit) {
        range = bound;
      } else {
        code -= bound;
        range -= bound;
      }
      *v = bit;
      *model = cell + change * 256 + (count < 254);
      while (range < 1u << 24) {
        code = (code << 8) | (position < n_data ? data[position] : 0);
        position++;
        range <<= 8;
      }
    }
  }
  return position;
}
