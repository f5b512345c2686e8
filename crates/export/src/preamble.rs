//! Sentences for the operator before a program runs.
//!
//! They state how the part lies on the axes, how far and how fast the axes move, how they reach the start, and what
//! only the operator can check. Numbers are those of the rounded motion, which the controller executes.

use planish_types::{Kinematics, Machine, Tilt, Transform};

use crate::{Approach, Origin, decimal, limits::Proof, plan::AxesPlan};

/// Number of decimals of a position in mm in sentences for people. Larger: numbers that are slow to read. Smaller:
/// positions that are too coarse to check. Chosen.
const DIGITS: usize = 4;

/// Returns the sentences, one per line of a header, without brackets and semicolons, which end a comment on some
/// controllers. `approach` says how the axes reach the start.
pub(crate) fn sentences<const N: usize>(
    plan: &AxesPlan<N>,
    origin: &Origin,
    (proof, reach): (&Proof, &[[f64; 2]; N]),
    approach: &Approach,
) -> Vec<String> {
    let machine = plan.machine;
    let mut lines = Vec::new();
    let stated = origin.part.line();
    if !stated.is_empty() {
        lines.push(stated);
    }
    if plan.contact.is_some() {
        lines.extend(kinematics(machine));
    } else if origin.was_on_axes {
        lines.push(
            "part: where the transform says that planish register applied, not where the machine file says".into(),
        );
    } else if let Some(transform) = machine.part_to_axes() {
        lines.push(place(transform));
    }
    for (axis, [low, high]) in plan.axes.iter().zip(*reach) {
        let name = axis.name;
        let unit = axis.unit();
        let travel = match axis.travel {
            Some([from, to]) => format!("its travel is {from} to {to} {unit}"),
            None if name == "c" => {
                "which counts on beyond a turn: the controller must not roll it over".into()
            }
            None => "the machine file states no travel".into(),
        };
        lines.push(format!(
            "reach: {name} from {} to {} {unit}, {travel}",
            decimal(low, DIGITS),
            decimal(high, DIGITS)
        ));
    }
    let fastest =
        proof.largest.iter().filter(|p| p.unit.ends_with("/s") || p.unit.ends_with("/s^2"));
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
    lines.push(
        "after an abort: the file .json beside this program has marks, line, time and position of every segment. \
         planish resume run=DIR abort_line=N plans the rest"
            .into(),
    );
    lines.push("the first time: run it with the tool off, and compare reach and total time".into());
    lines
}

/// Returns sentences on the axes of a machine, and on the position of the part on them.
fn kinematics(machine: &Machine) -> Vec<String> {
    let pivot = |mm: f64| format!("pivot {} mm from the contact point", decimal(mm, DIGITS));
    let (kind, tilts) = match machine.kinematics() {
        Kinematics::Xy => ("xy", None),
        Kinematics::Xyz => ("xyz", None),
        Kinematics::Tilts { pivot_mm, tilts } => {
            let carries = if tilts[0] == Tilt::A { "a carries b" } else { "b carries a" };
            ("xyz-tilts", Some(format!("{carries}, {}", pivot(*pivot_mm))))
        }
        Kinematics::Spindle { pivot_mm, .. } => ("spindle", pivot_mm.map(pivot)),
    };
    let names = machine.axes().iter().map(|a| format!("{} in {}", a.name, a.unit()));
    let tilts = tilts.map_or(String::new(), |t| format!(", {t}"));
    let names = names.collect::<Vec<_>>().join(", ");
    let mut lines = vec![format!("kinematics: {kind}{tilts}, axes {names}")];
    let is_spindle = matches!(machine.kinematics(), Kinematics::Spindle { .. });
    let stands = if is_spindle { "from the centre of the spindle" } else { "on the machine" };
    if let Some(transform) = machine.part_to_axes() {
        lines.push(format!("{} {stands}", place(transform)));
    }
    if machine.axes().iter().any(|a| a.name == "z") {
        lines.push(format!(
            "part: z reads {} mm where the tool, without tilt, touches the height 0 of the part",
            decimal(machine.part_origin_z_mm(), DIGITS)
        ));
    }
    lines
}

/// Returns the sentence that says where the origin of the part lies on the axes, and how the part is turned.
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
