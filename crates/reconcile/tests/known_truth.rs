//! Runs of known truth by a direct sum of their own; `examples/known_truth.rs` has 60 of them.

use crate::known::Case;
use ndarray::{Array2, s};
use planish_testkit::mirror::mirror;
use planish_types::{Axis, Grid, Surface};

/// A coupon, a strip and a plate, each with two noises.
#[test]
fn standard_errors_hold_and_the_next_mirror_is_that_of_a_known_tool() {
    let (mut within, mut of) = (0.0, 0.0);
    for sigma_nm in [0.05, 0.5] {
        let mut ratios = Vec::new();
        for seed in 0..3 {
            let case = Case::new(seed, sigma_nm);
            let found = case.learn();
            assert!(found.drawback.is_none(), "{seed}: {:?}", found.drawback);
            for (name, off) in case.over_errors(&found) {
                // What is refused states no number.
                let Some(off) = off else { continue };
                within += f64::from(off.abs() <= 2.0);
                of += 1.0;
                // 54 normal numbers are beyond 4.5 in one of 2700 sets.
                assert!(off.abs() < 4.5, "{seed}: {name} {off}");
            }
            let [learnt, without, known] = case.next_mirror_nm(&found);
            println!("{sigma_nm} nm, {}: {learnt:.4} {without:.4} {known:.4}", case.kind);
            assert!(learnt < without, "{seed}: {learnt} {without}");
            ratios.push(learnt / known);
        }
        ratios.sort_by(f64::total_cmp);
        // The bound of the middle one is that of the specification. At 0.05 nm the largest has it, too; at 0.5 nm the
        // noise of the two maps decides how well a small part knows its tool, and one in ten is beyond.
        let bounded = if sigma_nm < 0.1 { ratios[2] } else { ratios[1] };
        assert!(bounded < 1.15, "{sigma_nm}: {ratios:?}");
    }
    // 95.4 % of 54 numbers scatter by 2.9 %: three of it.
    assert!(of > 45.0 && within / of > 0.867, "{within} of {of}");
}

#[test]
fn maps_after_that_are_not_those_of_the_run_are_named() {
    let case = Case::new(1, 0.05);
    let after = case.after.height_nm();
    for (map, reading) in [
        (-after, "with its sign turned"),
        (0.5 * after, "times the heights"),
        (after.slice(s![..;-1, ..;-1]).to_owned(), "turned by 180 degrees"),
    ] {
        let found = case.learn_by(&Surface::new(*case.after.grid(), map).unwrap(), false);
        let said = found.drawback.unwrap();
        assert!(said.contains(reading), "{said}");
        // Nothing of it goes into the next run.
        assert!(found.outcome.parameters.iter().all(|e| e.value.is_none() && e.applied == 0.0));
        assert_eq!(found.tif.rate_nm_per_s(), case.tif.rate_nm_per_s());
    }
}

/// Every kind of wrong map, at a noise above and below what the plan leaves. What cannot be told is said, and nothing is
/// applied.
#[test]
fn no_wrong_map_after_teaches_anything() {
    for (seed, sigma_nm) in [(0, 0.5), (1, 0.5), (2, 0.5), (0, 0.05), (2, 0.05)] {
        let case = Case::new(seed, sigma_nm);
        let (after, before) = (case.after.height_nm(), case.before.height_nm());
        let other = Case::new(seed + 12, sigma_nm);
        assert_eq!(other.after.grid(), case.after.grid());
        let moved = |x: usize, y: usize| {
            Array2::from_shape_fn(after.dim(), |(r, c)| {
                match (r.checked_sub(y), c.checked_sub(x)) {
                    (Some(r), Some(c)) => after[[r, c]],
                    _ => f64::NAN,
                }
            })
        };
        let mut holes = after.clone();
        holes.slice_mut(s![10..14, 20..26]).fill(0.0);
        let step_mm = case.after.grid().x.step_mm();
        let two_mm = (2.0 / step_mm).round() as usize;
        for (name, map) in [
            ("another part", other.after.height_nm().clone()),
            ("sign", -after),
            ("twice", 2.0 * after),
            ("half", 0.5 * after),
            ("turned", after.slice(s![..;-1, ..;-1]).to_owned()),
            ("mirrored along x", after.slice(s![.., ..;-1]).to_owned()),
            ("mirrored along y", after.slice(s![..;-1, ..]).to_owned()),
            ("2 mm along x", moved(two_mm, 0)),
            ("2 mm along y", moved(0, two_mm)),
            ("zeros", holes),
            ("before again", before.clone()),
            ("piston", before + 5.0),
        ] {
            let found = case.learn_by(&Surface::new(*case.after.grid(), map).unwrap(), false);
            println!(
                "{seed} {sigma_nm} {} {name}: {:?} {:?}",
                case.kind, found.drawback, found.outcome.evidence
            );
            assert!(found.drawback.is_some(), "{seed} {sigma_nm} {} {name}", case.kind);
            assert!(found.outcome.parameters.iter().all(|e| e.applied == 0.0), "{name}");
            assert_eq!(found.tif.rate_nm_per_s(), case.tif.rate_nm_per_s());
        }
    }
}

/// The samples of the tool end at 1.5 % of its peak: what the tool removes beyond is in no displacement of the samples.
#[test]
fn samples_of_the_tool_that_end_too_early_bias_no_parameter() {
    for seed in [2, 4] {
        let case = Case::new(seed, 0.05).with_cut_tool(2.9);
        for (name, off) in case.over_errors(&case.learn()) {
            println!("{seed} {} {name} {off:?}", case.kind);
            // 18 normal numbers are beyond 4.5 in one of 8000 sets.
            assert!(off.is_none_or(|off| off.abs() < 4.5), "{seed}: {name} {off:?}");
        }
    }
}

/// Heights in tenths of a nanometre that are read as nanometres.
#[test]
fn a_map_after_in_another_unit_is_named() {
    for (seed, sigma_nm) in [(0, 0.5), (1, 0.05), (3, 0.05)] {
        let case = Case::new(seed, sigma_nm);
        let map = 10.0 * case.after.height_nm();
        let found = case.learn_by(&Surface::new(*case.after.grid(), map).unwrap(), false);
        println!("{seed} {sigma_nm} {}: {:?}", case.kind, found.drawback);
        assert!(found.drawback.is_some(), "{seed} {sigma_nm} {}", case.kind);
        assert!(found.outcome.parameters.iter().all(|e| e.applied == 0.0));
    }
}

/// Two runs on the reference mirror, whose figure hardly tells the parameters apart.
#[test]
fn runs_on_the_reference_mirror_teach_their_errors() {
    let Some(mirror) = mirror() else { return };
    for seed in 0..2 {
        let case = Case::on_mirror(&mirror, seed, 0.05);
        let found = case.learn();
        assert!(found.drawback.is_none(), "{seed}: {:?}", found.drawback);
        for (name, off) in case.over_errors(&found) {
            println!("{seed} {name} {off:?}");
            let off = off.unwrap_or_else(|| panic!("{seed}: {name} is refused"));
            // 18 normal numbers are beyond 4 in one of 900 sets.
            assert!(off.abs() < 4.0, "{seed}: {name} {off}");
        }
    }
}

#[test]
fn right_maps_after_are_never_named() {
    for seed in 1..=6 {
        let case = Case::new(seed, 0.5);
        let found = case.learn_from(&case.after);
        println!("{seed} {}: {:?}", case.kind, found.outcome.evidence);
        assert_eq!(found.outcome.explains_nothing, None, "{seed}");
    }
}

/// Maps on pixels that are displaced by half a pixel, or of another pitch, give the same numbers.
#[test]
fn a_map_after_on_other_pixels_gives_the_same_numbers() {
    let case = Case::new(2, 0.05);
    let own = case.learn();
    let grid = *case.after.grid();
    let half =
        |a: &Axis| Axis::new(a.start_mm() + 0.5 * a.step_mm(), a.step_mm(), a.len()).unwrap();
    let other =
        |a: &Axis| Axis::new(a.start_mm(), 1.13 * a.step_mm(), a.len() * 100 / 113).unwrap();
    for moved in
        [Grid { x: half(&grid.x), y: half(&grid.y) }, Grid { x: other(&grid.x), y: other(&grid.y) }]
    {
        let found = case.learn_from(&case.after_on(moved));
        assert!(found.outcome.resampled.is_some() && own.outcome.resampled.is_none());
        // The border of the stencil is lost.
        assert!(found.outcome.noise.pixels < own.outcome.noise.pixels);
        let valid: Array2<bool> = found.rest_nm.mapv(|v| !v.is_nan());
        assert!(valid[[10, 10]]);
        for (name, off) in case.over_errors(&found) {
            let Some(off) = off else { continue };
            // Nine normal numbers are beyond 3.5 in one of 240 sets.
            assert!(off.abs() < 3.5, "{name} {off}");
        }
    }
}
