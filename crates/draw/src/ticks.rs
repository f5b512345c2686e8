//! Round numbers to write beside an axis of a picture.

/// Tolerance by which a number may lie outside the interval, relative to the step (linear axis) or
/// to the end of the interval (logarithmic axis). Larger: numbers outside the frame. Smaller: the
/// number at an end is lost to rounding.
const SLACK: f64 = 1e-9;

/// Returns multiples of 1, 2 or 5 times a power of ten from `low` to `high` (both finite, `low` < `high`),
/// ascending. There are at most about `most` + 1 of them.
pub(crate) fn round_numbers(low: f64, high: f64, most: f64) -> Vec<f64> {
    let least = (high - low) / most;
    let power = least.log10().floor() as i32;
    let ten = 10.0_f64.powi(power);
    let step = [1.0, 2.0, 5.0].map(|f| f * ten).into_iter().find(|s| *s >= least);
    let step = step.unwrap_or(10.0 * ten);
    // Rounded to the decimals of the step: 0.3, not 0.30000000000000004.
    let decimals = usize::try_from(-power).unwrap_or(0);
    let first = (low / step - SLACK).ceil() as i64;
    let last = (high / step + SLACK).floor() as i64;
    let multiples = (first..=last).map(|k| k as f64 * step);
    // Adding 0.0 turns -0 into 0.
    multiples.map(|v| format!("{v:.decimals$}").parse().unwrap_or(v) + 0.0).collect()
}

/// Smallest number of values beside a logarithmic axis. If the axis has fewer powers of ten, multiples of them such
/// as 2 and 5 are added. Larger: a denser axis. With 2, an axis of one decade shows its ends only.
const FEWEST: usize = 3;

/// Returns the powers of ten from `low` to `high` (0 < `low` < `high`), ascending. If three or more exist, and more
/// than `most`, it returns only every second, third ... of them. If fewer than three exist, it adds multiples of powers
/// of ten: with 2 and 5, or with 1.5, 2, 3, 5 and 7 if that is too few.
pub(crate) fn round_logarithms(low: f64, high: f64, most: f64) -> Vec<f64> {
    let powers = multiples_of_powers(low, high, &[1.0]);
    if powers.len() >= FEWEST {
        let every = (powers.len() as f64 / most).ceil().max(1.0) as usize;
        return powers.into_iter().step_by(every).collect();
    }
    let few = multiples_of_powers(low, high, &[1.0, 2.0, 5.0]);
    if few.len() >= FEWEST {
        return few;
    }
    multiples_of_powers(low, high, &[1.0, 1.5, 2.0, 3.0, 5.0, 7.0])
}

/// Returns the products of `mantissas` with powers of ten that lie from `low` to `high` (both positive), power by
/// power in ascending order.
fn multiples_of_powers(low: f64, high: f64, mantissas: &[f64]) -> Vec<f64> {
    let interval = low * (1.0 - SLACK)..=high * (1.0 + SLACK);
    let mut numbers = Vec::new();
    for power in low.log10().floor() as i32..=high.log10().ceil() as i32 {
        for mantissa in mantissas {
            // Parsed from its decimal text: 0.3, not 0.30000000000000004.
            let number = format!("{mantissa}e{power}").parse().unwrap_or(f64::NAN);
            if interval.contains(&number) {
                numbers.push(number);
            }
        }
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_round_and_an_end_counts() {
        assert_eq!(
            round_numbers(-0.05, 0.35, 10.0),
            [-0.05, 0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35]
        );
        assert_eq!(round_numbers(-0.05, 0.35, 4.0), [0.0, 0.1, 0.2, 0.3]);
        assert_eq!(round_numbers(-3.0, 13.0, 8.0), [-2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0]);
        assert_eq!(round_numbers(0.0, 1e4, 10.0).len(), 11);
        assert_eq!(round_numbers(0.0, 92.3, 5.0), [0.0, 20.0, 40.0, 60.0, 80.0]);
        assert_eq!(round_numbers(-0.3, 0.3, 2.0), [0.0]);
        assert!(round_numbers(-0.3, 0.3, 2.0)[0].is_sign_positive());
    }

    #[test]
    fn a_logarithmic_axis_has_powers_of_ten_and_more_where_they_are_few() {
        assert_eq!(round_logarithms(0.02, 30.0, 10.0), [0.1, 1.0, 10.0]);
        assert_eq!(round_logarithms(1.0, 1e8, 5.0), [1.0, 100.0, 1e4, 1e6, 1e8]);
        assert_eq!(round_logarithms(0.3, 5.0, 10.0), [0.5, 1.0, 2.0, 5.0]);
        assert_eq!(round_logarithms(0.19, 0.6, 10.0), [0.2, 0.3, 0.5]);
    }
}
