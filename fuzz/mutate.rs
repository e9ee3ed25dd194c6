//! Seeded damage to bytes: flipped bits, numbers that lie, text that is no number, cuts, copies and splices.

/// Splitmix: the same seed gives the same damage on every machine.
pub struct Rng(pub u64);

impl Rng {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `n`; 0 if there is none.
    pub fn below(&mut self, n: usize) -> usize {
        self.next().checked_rem(n as u64).unwrap_or(0) as usize
    }

    pub fn pick<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }

    /// Begin and end within `length`, at most `most` apart.
    fn range(&mut self, length: usize, most: usize) -> std::ops::Range<usize> {
        let begin = self.below(length + 1);
        begin..(begin + self.below(most + 1)).min(length)
    }
}

const TEXTS: &[&str] = &[
    "",
    "-1",
    "0",
    "1e999",
    "nan",
    "inf",
    "-0.0",
    "1e-320",
    "18446744073709551616",
    "4294967295",
    "true",
    "null",
    "[]",
    "{}",
    "\"\"",
    "'",
    "\"",
    "\n",
    "=",
    "[[",
    "]]",
    "\u{0}",
    "\u{fffd}",
    "x = 1",
    "[a]",
    "[[a]]",
    "0x7fffffffffffffff",
    "1_0",
    "1e308",
];

/// `base` with one to eight places damaged; pieces of `other` may be spliced in.
pub fn mutate(rng: &mut Rng, base: &[u8], other: &[u8]) -> Vec<u8> {
    let mut bytes = base.to_vec();
    for _ in 0..=rng.below(8) {
        damage(rng, &mut bytes, other);
    }
    bytes
}

fn damage(rng: &mut Rng, bytes: &mut Vec<u8>, other: &[u8]) {
    let length = bytes.len();
    match rng.below(9) {
        0 | 1 if length > 0 => {
            let at = rng.below(length);
            bytes[at] ^= 1 << rng.below(8);
        }
        2 if length > 0 => {
            let at = rng.below(length);
            bytes[at] = *rng.pick(&[0, 1, 0x20, 0x22, 0x7f, 0x80, 0xff]);
        }
        3 => lie(rng, bytes),
        4 => {
            let cut = rng.range(length, 64);
            bytes.drain(cut);
        }
        5 => {
            let (from, at) = (rng.range(length, 64), rng.below(length + 1));
            let piece = bytes[from].to_vec();
            bytes.splice(at..at, piece);
        }
        6 => {
            let (from, to) = (rng.range(other.len(), 256), rng.range(length, 256));
            bytes.splice(to, other[from].iter().copied());
        }
        7 => say(rng, bytes),
        _ if rng.below(4) == 0 => bytes.truncate(rng.below(length + 1)),
        _ => say(rng, bytes),
    }
}

/// Overwrites 1, 2, 4 or 8 bytes by a number that a length or a count might lie with.
fn lie(rng: &mut Rng, bytes: &mut [u8]) {
    let length = bytes.len() as u64;
    let size = *rng.pick(&[1_usize, 2, 4, 8]);
    if bytes.len() < size {
        return;
    }
    let numbers =
        [0, 1, 0x7f, 0xff, 0xffff, 1 << 31, u64::from(u32::MAX), 1 << 62, u64::MAX, length, length + 1];
    let (number, at) = (*rng.pick(&numbers), rng.below(bytes.len() - size + 1));
    // Lengths lie in front, more often than elsewhere.
    let at = if rng.below(3) == 0 { at.min(rng.below(16)) } else { at };
    bytes[at..at + size].copy_from_slice(&number.to_le_bytes()[..size]);
}

/// Puts a text in place of a run of digits, or anywhere.
fn say(rng: &mut Rng, bytes: &mut Vec<u8>) {
    let start = rng.below(bytes.len() + 1);
    let is_number = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'e');
    let found = bytes[start..].iter().position(is_number).map(|n| start + n);
    let at = found.filter(|_| rng.below(4) != 0).unwrap_or(start);
    let run = bytes[at..].iter().take_while(|b| is_number(b)).count();
    let text = *rng.pick(TEXTS);
    bytes.splice(at..at + run, text.bytes());
}
