//! Dwell time of the tool at each dwell point.

use crate::Invalid;

/// Largest dwell time of a point, s: thirty years. Larger values are a mistake in the units. It is
/// no limit of a real run.
const LONGEST_S: f64 = 1e9;

/// Dwell times in s, one per segment of a tool path; finite and >= 0.
#[derive(Clone, Debug, PartialEq)]
pub struct DwellTime {
    dwell_s: Vec<f64>,
}

impl DwellTime {
    /// Returns the dwell times (n), s. Refuses an empty array, and dwell times that are negative, above 1e9 s or not
    /// finite.
    pub fn new(dwell_s: Vec<f64>) -> Result<Self, Invalid> {
        if dwell_s.is_empty() {
            return Err(Invalid::whole(
                "dwell_s",
                "is empty",
                "give one dwell time per dwell point",
            ));
        }
        if let Some(i) = dwell_s.iter().position(|t| !(0.0..=LONGEST_S).contains(t)) {
            let problem = format!("is {:?} s", dwell_s[i]);
            let remedy = "dwell times are not negative and at most 1e9 s; give seconds";
            return Err(Invalid::at_index("dwell_s", i, problem, remedy));
        }
        Ok(Self { dwell_s })
    }

    /// Returns the dwell time of each dwell point (n), s.
    pub fn dwell_s(&self) -> &[f64] {
        &self.dwell_s
    }

    /// Returns the sum of all dwell times, s.
    pub fn total_s(&self) -> f64 {
        self.dwell_s.iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn negative_and_nan_are_refused_with_index_and_value() {
        let message = |v| DwellTime::new(v).unwrap_err().to_string();
        assert!(message(vec![0.1, -0.2]).contains("dwell_s[1]: is -0.2 s"));
        assert!(message(vec![f64::NAN]).contains("dwell_s[0]: is NaN"));
        assert!(message(vec![]).contains("empty"));
        assert_eq!(DwellTime::new(vec![0.0, 1.5]).unwrap().total_s(), 1.5);
    }
}
