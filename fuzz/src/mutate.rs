//! Mutations that know the format: numbers in text, and the length of a model's header.

use crate::mutants::{Mutants, Random};

/// A format-independent change of bytes: takes the buffer, the number of used bytes and the capacity, and
/// returns the new number of used bytes.
pub type Step = fn(&mut [u8], usize, usize) -> usize;

/// Texts of special numbers that readers must handle, and an empty text.
const WORDS: &str = "0 1 2 -1 7 0.5 255 65536 1000000 4294967295 4294967296 9223372036854775807 \
                     18446744073709551615 18446744073709551616 1e39 1e300 1e309 1e-40 -0 nan inf ";

/// Returns the random number generator of a seed.
pub fn random(seed: u32) -> Random {
    Random::new((u64::from(seed) << 1 | 1).wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

/// Returns a mutation of the number `own`: a number near it, a limit, or a random number.
pub fn number(random: &mut Random, own: f64) -> f64 {
    let unit = random.bits() as f64 / u64::MAX as f64;
    let edges = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.01,
        1e-12,
        1e4,
        1e12,
        1e300,
        f64::MIN_POSITIVE,
        5e-324,
        f64::MAX,
        f64::NAN,
        f64::INFINITY,
    ];
    match random.below(8) {
        0 => edges[random.below(edges.len())],
        1 => -own,
        2 => own * 2.0 * unit,
        3 => own + unit - 0.5,
        4 => 10f64.powf(40.0 * unit - 20.0),
        5 => f64::from_bits(random.bits() % 4),
        6 => f64::from_bits(random.bits()),
        _ => unit,
    }
}

/// Copies as many of `bytes` into `data` as `room` allows; returns their number.
pub(crate) fn put(data: &mut [u8], bytes: &[u8], room: usize) -> usize {
    let length = bytes.len().min(room).min(data.len());
    data[..length].copy_from_slice(&bytes[..length]);
    length
}

/// Changes a text, the first `size` bytes of `data`: replaces a number by another, repeats or deletes a line,
/// or applies the byte mutation `step`. Returns the new number of used bytes.
pub fn text(data: &mut [u8], size: usize, room: usize, seed: u32, step: Step) -> usize {
    let mut random = random(seed);
    let mut bytes = data[..size].to_vec();
    match random.below(4) {
        0 | 1 => {
            let part = |b: u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'+');
            let starts: Vec<usize> =
                (0..size).filter(|&i| bytes[i].is_ascii_digit() && (i == 0 || !part(bytes[i - 1]))).collect();
            if starts.is_empty() {
                return step(data, size, room);
            }
            let start = starts[random.below(starts.len())];
            let end = (start..size).find(|&i| !part(bytes[i])).unwrap_or(size);
            let words: Vec<&str> = WORDS.split(' ').collect();
            bytes.splice(start..end, words[random.below(words.len())].bytes());
        }
        2 => {
            let mut lines: Vec<Vec<u8>> =
                bytes.split_inclusive(|&b| b == b'\n').map(<[u8]>::to_vec).collect();
            if lines.len() < 2 {
                return step(data, size, room);
            }
            let (from, to) = (random.below(lines.len()), random.below(lines.len()));
            if random.below(3) == 0 {
                lines.remove(from);
            } else {
                let line = lines[from].clone();
                lines.insert(to, line);
            }
            bytes = lines.concat();
        }
        _ => return step(data, size, room),
    }
    put(data, &bytes, room)
}

/// Changes the header or the tensors of a model file, the first `size` bytes of `data`, and then corrects the
/// stored length of the header; or writes a generated model instead. Returns the new number of used bytes.
pub fn model(data: &mut [u8], size: usize, room: usize, seed: u32, step: Step) -> usize {
    let mut random = random(seed);
    let header = data[..size]
        .split_first_chunk::<8>()
        .and_then(|(length, rest)| Some((usize::try_from(u64::from_le_bytes(*length)).ok()?, rest)))
        .and_then(|(length, rest)| rest.split_at_checked(length));
    let Some((header, tensors)) = header.filter(|_| random.below(8) > 0) else {
        return put(data, &Mutants::new(random.bits(), &[]).next_file(), room);
    };
    let (mut header, mut tensors) = (header.to_vec(), tensors.to_vec());
    let all = header.len() + tensors.len();
    let part = if random.below(3) > 0 { &mut header } else { &mut tensors };
    let spent = 8 + all - part.len();
    let (length, most) = (part.len(), room.saturating_sub(spent).max(part.len()));
    part.resize(most, 0);
    let length = if random.below(2) == 0 {
        text(part, length, most, random.bits() as u32, step)
    } else {
        step(part, length, most)
    };
    part.truncate(length);
    let bytes = [&(header.len() as u64).to_le_bytes()[..], &header, &tensors].concat();
    put(data, &bytes, room)
}
