//! Time stamps that are numbers, stored as differences from the first one.
//!
//! A stamp is kept as a whole number and a fraction. The difference of two stamps since 1970 then has the resolution of the
//! text: as one double of 1.8e9 s it would have steps of 2.4e-7 s, and one of 1.8e18 ns steps of 256 ns.

/// Number of digits that a whole number may have to fit into 64 bits for certain. A whole part may have one digit more
/// if it fits; other numbers are read as doubles.
const MOST_DIGITS: usize = 18;

/// Numeric time stamps of a column, in its unit.
#[derive(Clone, Debug, Default)]
pub struct Stamps {
    /// Differences of the stamps from the first one (n).
    pub differences: Vec<f64>,
    /// The first stamp as a double, in the unit of the column.
    pub first: f64,
    start: (i64, f64),
    /// Number of decimals of the stamp that has the most.
    decimals: i32,
}

impl Stamps {
    /// Appends the stamp in the text of a cell. Returns false, and appends nothing, if it is no finite number or is
    /// 9e18 or more.
    pub fn push(&mut self, field: &str) -> bool {
        let Some((whole, fraction, decimals)) = parts(field) else { return false };
        if self.differences.is_empty() {
            self.start = (whole, fraction);
            self.first = whole as f64 + fraction;
        }
        self.decimals = self.decimals.max(decimals);
        // Far apart only in a damaged file; the sum of doubles is then as good.
        let whole = whole.checked_sub(self.start.0).map_or(f64::MAX, |whole| whole as f64);
        self.differences.push(whole + (fraction - self.start.1));
        true
    }

    /// Removes the last stamp, of a line that turned out to be no sample.
    pub fn pop(&mut self) {
        self.differences.pop();
    }

    /// Returns the unit of the last digit of the stamp with the most decimals, such as 0.001.
    pub fn resolution(&self) -> f64 {
        10f64.powi(-self.decimals)
    }
}

/// Splits a number in text into whole number, fraction and number of decimals. Returns `None` for text that is no
/// finite number, and for numbers of 9e18 or more.
fn parts(field: &str) -> Option<(i64, f64, i32)> {
    let unsigned = field.strip_prefix(['-', '+']).unwrap_or(field);
    let (whole, fraction) = unsigned.split_once('.').unwrap_or((unsigned, ""));
    let are_digits = whole.bytes().chain(fraction.bytes()).all(|b| b.is_ascii_digit());
    let has_digits = (1..=MOST_DIGITS + 1).contains(&whole.len()) && fraction.len() <= MOST_DIGITS;
    if are_digits && has_digits {
        let sign = if field.starts_with('-') { -1 } else { 1 };
        let part: f64 = match fraction {
            "" => 0.0,
            digits => format!("0.{digits}").parse().ok()?,
        };
        if let Ok(whole) = whole.parse::<i64>() {
            return Some((sign * whole, sign as f64 * part, fraction.len() as i32));
        }
    }
    let value: f64 = field.parse().ok()?;
    if !value.is_finite() || value.abs() >= 9e18 {
        return None;
    }
    let (mantissa, exponent) = field.split_once(['e', 'E']).unwrap_or((field, "0"));
    let decimals = mantissa.split_once('.').map_or(0, |(_, digits)| digits.len() as i32);
    let exponent: i32 = exponent.parse().ok()?;
    Some((value.trunc() as i64, value.fract(), (decimals - exponent).clamp(0, 30)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_keep_the_digits_of_the_text() {
        let of = |texts: &[&str]| {
            let mut stamps = Stamps::default();
            assert!(texts.iter().all(|text| stamps.push(text)), "{texts:?}");
            (stamps.differences.clone(), stamps.resolution())
        };
        // Nanoseconds since 1970: 1760000000123456789 as a double has steps of 256.
        let (ns, resolution) = of(&["1760000000123456789", "1760000000124456790"]);
        assert_eq!((ns, resolution), (vec![0.0, 1_000_001.0], 1.0));
        // Rounding of numbers below 1.
        let (s, resolution) = of(&["1772366400.999900", "1772366401.000000"]);
        assert!((s[1] - 1e-4).abs() < 2e-16 && resolution == 1e-6, "{s:?}");
        assert_eq!(of(&["-1.5", "-0.5", "+0.25", "1e-3"]).0, [0.0, 1.0, 1.75, 1.501]);
        assert_eq!(of(&["0", "1.66666667e-05"]).1, 1e-13);
        let mut stamps = Stamps::default();
        for text in ["", "nan", "inf", "1e30", "a", "1.2.3", "--1"] {
            assert!(!stamps.push(text), "{text}");
        }
    }
}
