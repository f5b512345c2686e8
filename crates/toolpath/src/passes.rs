//! Repetition of a path: there and back, or always forwards.
//!
//! If one pass goes there and the next one back, every place is passed at times that are symmetrical about the turn.
//! A linear drift of the removal rate is then too high in one pass by as much as it is too low in the other. With N
//! passes each takes about one N-th of the dwell time. The floor of the machine holds in each of them.

use planish_types::{Invalid, ToolPath};

use crate::{MAX_SEGMENTS, draft::Draft};

/// Number and direction of the passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct PassesSettings {
    /// Number of passes over the path; >= 2.
    pub passes: usize,
    /// True if every second pass runs backwards; otherwise the tool is lifted back to the start.
    #[serde(rename = "return")]
    pub back: bool,
}

/// Repeats `path` as often as `settings` say. Passes of the path keep numbers of their own in every repetition. Refuses
/// fewer than two passes, and more segments or numbers of passes than a path may have.
pub fn passes(path: &ToolPath, settings: &PassesSettings) -> Result<ToolPath, Invalid> {
    let PassesSettings { passes, back } = *settings;
    let n = path.len();
    check_count(passes, n)?;
    let first = path.pass_idx().iter().min().copied().unwrap_or(0);
    let last = path.pass_idx().iter().max().copied().unwrap_or(0);
    // All of them are counted in 64 bits.
    let span = last.checked_sub(first).and_then(|d| d.checked_add(1));
    let Some(own) = span.filter(|own| own.checked_mul(passes as i64).is_some()) else {
        let problem = format!("reach from {first} to {last}");
        return Err(Invalid::whole("pass_idx", problem, "count the passes from 0"));
    };
    let own = own as usize;
    let mut draft = Draft::default();
    let mut dwell_point_mm = Vec::with_capacity(passes * (n + 1));
    let points = path.point_mm();
    draft.begin(points[0]);
    for pass in 0..passes {
        let backwards = back && pass % 2 == 1;
        let index = |i: usize| {
            let pass_of_path = (path.pass_idx()[i] - first) as usize;
            pass * own + if backwards { own - 1 - pass_of_path } else { pass_of_path }
        };
        let here = draft.point_mm[draft.point_mm.len() - 1];
        if pass > 0 && !back && here != points[0] {
            draft.to(points[0], false, index(0));
            dwell_point_mm.push([0, 1].map(|a| 0.5 * (here[a] + points[0][a])));
        }
        for k in 0..n {
            let i = if backwards { n - 1 - k } else { k };
            let to = if backwards { points[i] } else { points[i + 1] };
            draft.to(to, path.tool_on()[i], index(i));
            dwell_point_mm.push(path.dwell_point_mm()[i]);
        }
    }
    ToolPath::new(draft.point_mm, dwell_point_mm, draft.tool_on, draft.pass_idx)
}

/// Refuses fewer than two passes, and more than [`MAX_SEGMENTS`] segments in all passes, their lifts included.
fn check_count(passes: usize, segments: usize) -> Result<(), Invalid> {
    // A lift between two passes is a segment more.
    let most = MAX_SEGMENTS / (segments + 1);
    let remedy = match most {
        0 | 1 => format!("two of {segments} segments are too many: give a path of fewer"),
        _ => format!("give 2 to {most} for a path of {segments} segments"),
    };
    match passes {
        2.. if passes <= most => Ok(()),
        _ => Err(Invalid::whole("passes", format!("are {passes}"), remedy)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path() -> ToolPath {
        let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]];
        let dwell = vec![[0.4, 0.0], [1.5, 0.0], [2.0, 0.5], [1.0, 1.0]];
        ToolPath::new(points, dwell, vec![true, true, false, true], vec![0, 0, 0, 1]).unwrap()
    }

    #[test]
    fn there_and_back_is_a_palindrome() {
        let twice = passes(&path(), &PassesSettings { passes: 2, back: true }).unwrap();
        assert_eq!(twice.len(), 8);
        let n = twice.len();
        for i in 0..n {
            assert_eq!(twice.point_mm()[i], twice.point_mm()[n - i]);
            assert_eq!(twice.dwell_point_mm()[i], twice.dwell_point_mm()[n - 1 - i]);
            assert_eq!(twice.tool_on()[i], twice.tool_on()[n - 1 - i]);
        }
        assert_eq!(twice.dwell_point_mm()[0], [0.4, 0.0]);
        assert_eq!(twice.pass_idx(), [0, 0, 0, 1, 2, 3, 3, 3]);
    }

    #[test]
    fn forwards_again_lifts_the_tool_back_to_the_start() {
        let thrice = passes(&path(), &PassesSettings { passes: 3, back: false }).unwrap();
        assert_eq!(thrice.len(), 3 * 4 + 2);
        assert_eq!(thrice.point_mm()[5], [0.0, 0.0]);
        assert_eq!(thrice.dwell_point_mm()[4], [0.0, 0.5]);
        let on: Vec<u8> = thrice.tool_on().iter().map(|on| u8::from(*on)).collect();
        assert_eq!(on, [1, 1, 0, 1, 0, 1, 1, 0, 1, 0, 1, 1, 0, 1]);
        assert_eq!(thrice.pass_idx(), [0, 0, 0, 1, 2, 2, 2, 2, 3, 4, 4, 4, 4, 5]);
        // A closed line needs none.
        let closed = vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]];
        let closed = ToolPath::through(closed, vec![true; 3], vec![0; 3]).unwrap();
        let twice = passes(&closed, &PassesSettings { passes: 2, back: false }).unwrap();
        assert_eq!((twice.len(), twice.pass_idx()[3]), (6, 1));
    }

    #[test]
    fn one_pass_and_too_many_are_refused() {
        for count in [0, 1, usize::MAX] {
            let message = passes(&path(), &PassesSettings { passes: count, back: true });
            let message = message.unwrap_err().to_string();
            assert!(message.contains(&format!("passes: are {count}; give 2 to")), "{message}");
        }
        assert!(check_count(2, MAX_SEGMENTS / 2 - 1).is_ok());
        let message = check_count(2, MAX_SEGMENTS / 2).unwrap_err().to_string();
        assert!(message.contains("give a path of fewer"), "{message}");
    }

    #[test]
    fn passes_that_cannot_be_counted_are_refused() {
        for far in [i64::MAX, i64::MAX / 2] {
            let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]];
            let path = ToolPath::through(points, vec![true; 2], vec![0, far]).unwrap();
            let message = passes(&path, &PassesSettings { passes: 3, back: true }).unwrap_err();
            let expected = format!("pass_idx: reach from 0 to {far}; count the passes from 0");
            assert_eq!(message.to_string(), expected);
        }
    }
}
