//! Numbers as text in a page: base64 of little-endian 16-bit integers with a stated scale, or of
//! 32-bit floats, or of 64-bit floats where they are times.
//!
//! ```text
//! value = offset + scale q,   q = -32767 .. 32767,   q = -32768 stands for NaN
//! ```
//!
//! so a value is off by at most half a step, `scale / 2`; by less than one step where it is rounded down or up.

use serde::Serialize;

/// A list of numbers as text: 16-bit integers q with an offset and a scale.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Packed {
    /// Offset of the values: the middle of their range, in their unit.
    pub offset: f64,
    /// Scale of the values: the step between two neighbouring integers, in their unit.
    pub scale: f64,
    /// Integers q of the module, as base64 of little-endian 16-bit numbers.
    pub i16: String,
}

/// Largest magnitude of a quantised value, dimensionless. Derived: the largest one that a signed 16-bit integer has
/// with both signs; -32768 stands for NaN.
const LARGEST_STORED_INTEGER: f64 = 32767.0;

/// Direction in which a value between two integers is rounded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rounding {
    /// Rounds to the nearest step.
    Nearest,
    /// Rounds to the step below, so that a lower end of a range remains a lower bound.
    Down,
    /// Rounds to the step above, so that an upper end of a range remains an upper bound.
    Up,
}

/// Packs `values` with offset and scale from their own range; NaN stays NaN.
pub fn pack(values: impl Iterator<Item = f64> + Clone) -> Packed {
    let valid = values.clone().filter(|v| !v.is_nan());
    let (low, high) =
        valid.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
    pack_between(values, low, high, Rounding::Nearest)
}

/// Packs `values`, which all lie from `low` to `high`, with offset and scale of that range; NaN stays NaN. `rounding`
/// says to which of the two neighbouring integers a value goes.
pub fn pack_between(
    values: impl Iterator<Item = f64>,
    low: f64,
    high: f64,
    rounding: Rounding,
) -> Packed {
    let offset = 0.5 * (low + high);
    let half = 0.5 * (high - low);
    let scale = if half > 0.0 { half / LARGEST_STORED_INTEGER } else { 1.0 };
    let mut bytes = Vec::new();
    for v in values {
        let steps = (v - offset) / scale;
        let rounded = match rounding {
            Rounding::Nearest => steps.round(),
            Rounding::Down => steps.floor(),
            Rounding::Up => steps.ceil(),
        };
        let stored = rounded.clamp(-LARGEST_STORED_INTEGER, LARGEST_STORED_INTEGER) as i16;
        let q = if v.is_nan() { i16::MIN } else { stored };
        bytes.extend(q.to_le_bytes());
    }
    Packed { offset, scale, i16: base64(&bytes) }
}

/// Returns `values` as base64 of little-endian 32-bit floats.
pub fn floats(values: impl Iterator<Item = f64>) -> String {
    base64(&values.flat_map(|v| (v as f32).to_le_bytes()).collect::<Vec<u8>>())
}

/// Returns `values` as base64 of little-endian 64-bit floats. It is for times, because the last one must be exactly
/// the end of the motion.
pub fn doubles(values: impl Iterator<Item = f64>) -> String {
    base64(&values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>())
}

/// Returns `bytes` as base64 by RFC 4648, with padding.
pub fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let [a, b, c] = [0, 1, 2].map(|i| u32::from(chunk.get(i).copied().unwrap_or(0)));
        let word = a << 16 | b << 8 | c;
        for i in 0..4 {
            let letter = LETTERS[(word >> (18 - 6 * i) & 63) as usize] as char;
            text.push(if i <= chunk.len() { letter } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the integers in a packed text, by a decoder that shares nothing with the encoder.
    fn integers(text: &str) -> Vec<i16> {
        let value = |c: u8| match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            _ => 63,
        };
        let mut bits = 0_u32;
        let mut count = 0;
        let mut bytes = vec![];
        for c in text.bytes().filter(|c| *c != b'=') {
            bits = bits << 6 | u32::from(value(c));
            count += 6;
            if count >= 8 {
                count -= 8;
                bytes.push((bits >> count) as u8);
            }
        }
        bytes.chunks_exact(2).map(|b| i16::from_le_bytes([b[0], b[1]])).collect()
    }

    #[test]
    fn base64_of_the_standard() {
        // RFC 4648, section 10.
        for (bytes, text) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xfb, 0xff]), "+/8=");
    }

    #[test]
    fn a_value_comes_back_to_half_a_step_and_nan_as_itself() {
        let values = [3.0, -1.5, f64::NAN, 2.2222, -0.1];
        let packed = pack(values.iter().copied());
        assert!((packed.scale - 4.5 / 65534.0).abs() < 1e-18);
        for (v, q) in values.iter().zip(integers(&packed.i16)) {
            if v.is_nan() {
                assert_eq!(q, i16::MIN);
            } else {
                let back = packed.offset + packed.scale * f64::from(q);
                assert!((back - v).abs() <= 0.5000001 * packed.scale, "{v} {back}");
            }
        }
        assert_eq!(integers(&pack([7.0; 3].into_iter()).i16), [0, 0, 0]);
        assert_eq!(pack([f64::NAN].into_iter()).offset, 0.0);
    }

    #[test]
    fn ranges_are_rounded_outwards() {
        for (rounding, sign) in [(Rounding::Down, 1.0), (Rounding::Up, -1.0)] {
            let packed = pack_between([0.123, 0.456].into_iter(), 0.0, 1.0, rounding);
            for (v, q) in [0.123, 0.456].into_iter().zip(integers(&packed.i16)) {
                let back = packed.offset + packed.scale * f64::from(q);
                assert!((0.0..packed.scale).contains(&(sign * (v - back))), "{v} {back}");
            }
        }
    }
}
