//! Difference of two arrays.
//!
//! ```text
//! largest = max_i |a_i - b_i|        RMS = sqrt(mean_i (a_i - b_i)^2)
//! ```
//!
//! over the elements that are not NaN in both. NaN against a number is an infinite difference.

use ndarray::{ArrayD, Dimension};
use planish_types::Invalid;

/// Elements of an array, all of one type.
#[derive(Clone, Debug, PartialEq)]
pub enum Elements {
    /// Floats; [`difference`] does not count elements that are NaN in both arrays.
    Float(ArrayD<f64>),
    /// Integers or flags, which are compared exactly.
    Integer(ArrayD<i64>),
}

/// Difference of two arrays that have the same name in two artifacts.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Largest absolute difference of two elements, in the unit of the array.
    pub largest: f64,
    /// Index of the largest difference (the first of equals), and the two values as text; `None` if the arrays are
    /// equal.
    pub at: Option<(Vec<usize>, [String; 2])>,
    /// RMS of the differences over all elements that are not NaN in both arrays, in the unit of the array.
    pub rms: f64,
}

impl Difference {
    /// Returns one line: `name: largest difference ... at [index] (A ..., B ...), RMS ...`, or `name: equal`.
    pub fn line(&self, name: &str) -> String {
        match &self.at {
            None => format!("{name}: equal"),
            Some((index, [a, b])) => format!(
                "{name}: largest difference {:e} at {index:?} (A {a}, B {b}), RMS {:e}",
                self.largest, self.rms
            ),
        }
    }
}

/// Returns a sentence that names the arrays whose largest difference exceeds `max_difference`; `None` if there is
/// none. Each difference has the name of its arrays.
///
/// # Errors
/// Refuses a `max_difference` that is negative or NaN.
pub fn beyond(
    differences: &[(String, Difference)],
    max_difference: f64,
) -> Result<Option<String>, Invalid> {
    if max_difference.is_nan() || max_difference < 0.0 {
        let remedy = "give a number that is not negative";
        return Err(Invalid::whole("max_difference", format!("is {max_difference}"), remedy));
    }
    let beyond: Vec<String> = differences
        .iter()
        .filter(|(_, difference)| difference.largest > max_difference)
        .map(|(name, difference)| format!("{name} by {:e}", difference.largest))
        .collect();
    if beyond.is_empty() {
        return Ok(None);
    }
    Ok(Some(format!("above {max_difference:e}: {}", beyond.join(", "))))
}

/// Compares two arrays element by element.
///
/// # Errors
/// Refuses arrays of unlike shapes, and floats against integers.
pub fn difference(a: &Elements, b: &Elements) -> Result<Difference, String> {
    match (a, b) {
        (Elements::Float(a), Elements::Float(b)) => compare(a, b, float_distance),
        (Elements::Integer(a), Elements::Integer(b)) => compare(a, b, integer_distance),
        (a, b) => Err(format!("A holds {}, B holds {}", a.what(), b.what())),
    }
}

impl Elements {
    fn what(&self) -> &'static str {
        match self {
            Self::Float(_) => "floats",
            Self::Integer(_) => "integers",
        }
    }
}

/// Returns the distance |a - b|; infinite if only one of them is NaN, and `None` if both are.
fn float_distance(a: f64, b: f64) -> Option<f64> {
    match (a.is_nan(), b.is_nan()) {
        (true, true) => None,
        (true, false) | (false, true) => Some(f64::INFINITY),
        // Equal infinities have no difference.
        (false, false) => Some(if a == b { 0.0 } else { (a - b).abs() }),
    }
}

/// Returns the distance |a - b| without overflow; at least 1 if they differ, also after rounding to a float. It is
/// never `None`, since every integer counts.
fn integer_distance(a: i64, b: i64) -> Option<f64> {
    Some(a.abs_diff(b) as f64)
}

/// Compares two arrays of one element type. `distance` returns `None` for elements that do not count.
fn compare<T: Copy + std::fmt::Display>(
    a: &ArrayD<T>,
    b: &ArrayD<T>,
    distance: impl Fn(T, T) -> Option<f64>,
) -> Result<Difference, String> {
    if a.shape() != b.shape() {
        return Err(format!("A has the shape {:?}, B {:?}", a.shape(), b.shape()));
    }
    let mut largest = 0.0;
    let mut at = None;
    let mut squares = 0.0;
    let mut count = 0_usize;
    for ((index, &x), &y) in a.indexed_iter().zip(b) {
        let Some(d) = distance(x, y) else { continue };
        count += 1;
        squares += d * d;
        if d > largest {
            largest = d;
            at = Some((index.slice().to_vec(), [x.to_string(), y.to_string()]));
        }
    }
    Ok(Difference { largest, at, rms: (squares / count.max(1) as f64).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    const NAN: f64 = f64::NAN;
    const INF: f64 = f64::INFINITY;

    #[test]
    fn the_largest_difference_with_its_place_and_the_rms() {
        let a = Elements::Float(array![[1.0, 2.0, NAN], [4.0, 5.0, 6.0]].into_dyn());
        let b = Elements::Float(array![[1.0, 2.5, NAN], [4.0, 5.0, 4.0]].into_dyn());
        let d = difference(&a, &b).unwrap();
        assert_eq!((d.largest, &d.at), (2.0, &Some((vec![1, 2], ["6".into(), "4".into()]))));
        // (0.5^2 + 2^2) over the five elements that are not NaN.
        assert_eq!(d.rms, (4.25_f64 / 5.0).sqrt());
        assert_eq!(difference(&b, &a).unwrap().largest, 2.0);
        assert!(d.line("z").contains("z: largest difference 2e0 at [1, 2] (A 6, B 4), RMS"));
        let d = difference(&a, &a).unwrap();
        assert_eq!((d.largest, d.rms, d.line("z").as_str()), (0.0, 0.0, "z: equal"));
    }

    #[test]
    fn what_is_beyond_the_tolerance_is_named() {
        let one = |v: f64| Elements::Float(array![v].into_dyn());
        let named = |name: &str, b| (name.to_string(), difference(&one(0.0), &one(b)).unwrap());
        let found = [named("near", 0.5), named("far", 2.0)];
        assert_eq!(beyond(&found, 2.0), Ok(None));
        assert_eq!(beyond(&found, 1.0), Ok(Some("above 1e0: far by 2e0".into())));
        for wrong in [-1.0, NAN] {
            let message = beyond(&found, wrong).unwrap_err().to_string();
            assert!(message.contains(&format!("max_difference: is {wrong}")), "{message}");
        }
    }

    #[test]
    fn nan_against_a_number_is_infinitely_far() {
        let one = |v: f64| Elements::Float(array![v].into_dyn());
        let d = |a, b| difference(&one(a), &one(b)).unwrap().largest;
        assert_eq!((d(NAN, 1.0), d(1.0, NAN), d(NAN, NAN)), (INF, INF, 0.0));
        assert_eq!((d(INF, INF), d(INF, -INF), d(INF, 1.0)), (0.0, INF, INF));
    }

    #[test]
    fn integers_are_compared_exactly() {
        let one = |v: i64| Elements::Integer(array![v].into_dyn());
        let d = |a, b| difference(&one(a), &one(b)).unwrap().largest;
        // Beyond 2^53, where the floats of both are the same.
        assert_eq!(d(i64::MAX, i64::MAX - 1), 1.0);
        assert_eq!(d(i64::MIN, i64::MAX), 2.0_f64.powi(64));
    }

    #[test]
    fn unlike_arrays_are_refused() {
        let a = Elements::Float(array![1.0, 2.0].into_dyn());
        let b = Elements::Float(array![[1.0, 2.0]].into_dyn());
        let c = Elements::Integer(array![1, 2].into_dyn());
        assert_eq!(difference(&a, &b).unwrap_err(), "A has the shape [2], B [1, 2]");
        assert_eq!(difference(&a, &c).unwrap_err(), "A holds floats, B holds integers");
    }
}
