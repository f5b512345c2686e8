//! Sentences for the operator before a program runs.
//!
//! How a part lies on the axes, how far the axes go, how fast, how they come to the start, and what nobody but the
//! operator can see to. Numbers are those of the rounded motion, which the controller executes.

use planish_types::{Machine, Transform};

use crate::{Approach, Origin, decimal, limits::Proof};

/// Number of decimals of a position in mm, for people. Larger: numbers that are slow to read. Smaller: positions that
/// are too coarse to check. Chosen.
const DIGITS: usize = 4;

/// One sentence per line of a header, without the brackets and semicolons that end a comment somewhere.
pub(crate) fn sentences(
    machine: &Machine,
    origin: &Origin,
    proof: &Proof,
    approach: &Approach,
) -> Vec<String> {
    let axes = machine.limits().axes();
    let mut lines = Vec::new();
    if origin.was_on_axes {
        lines.push(
            "part: where the transform says that planish-register applied, not where the machine file says".into(),
        );
    } else if let Some(transform) = machine.part_to_axes() {
        lines.push(place(transform));
    }
    for (axis, limits) in axes.iter().enumerate() {
        let [low, high] = proof.reach_mm[axis];
        let travel = match machine.travel_mm()[axis] {
            Some([from, to]) => format!("its travel is {from} to {to} mm"),
            None => "the machine file states no travel".into(),
        };
        let name = limits.name();
        lines.push(format!(
            "reach: {name} from {} to {} mm, {travel}",
            decimal(low, DIGITS),
            decimal(high, DIGITS)
        ));
    }
    let fastest = proof.largest.iter().filter(|p| p.unit == "mm/s" || p.unit == "mm/s^2");
    let fastest: Vec<String> = fastest
        .map(|p| format!("{} {:.4} of {} {}", p.quantity, p.value, p.limit, p.unit))
        .collect();
    lines.push(format!("largest: {}", fastest.join(", ")));
    lines.push(
        "before 1: home the axes, with the tool off or away from the part, and nothing else within the reach"
            .into(),
    );
    lines.push(format!(
        "before 2: {}",
        match approach {
            Approach::InProgram(how) | Approach::Before(how) => how,
        }
    ));
    lines.push(
        "before 3: feed override 100 %, and locked: what runs slower removes more in proportion"
            .into(),
    );
    lines.push("the first time: run it with the tool off, and compare reach and total time".into());
    lines
}

/// Sentence on the position of a part on the axes.
fn place(transform: &Transform) -> String {
    let [x, y] = transform.point([0.0, 0.0]);
    let [[xx, _], [yx, _]] = *transform.matrix();
    let turned_over = if transform.mirrors() { ", and its y axis on the other side" } else { "" };
    format!(
        "part: its origin where the axes read x {} mm, y {} mm, its x axis {} degrees from that of the machine \
         towards y{turned_over}",
        decimal(x, DIGITS),
        decimal(y, DIGITS),
        decimal(yx.atan2(xx).to_degrees(), 6)
    )
}
