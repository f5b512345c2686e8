//! A machine with a part on it: limits of its axes, their travel, and the position of the part.
//!
//! A plan is made in the coordinates of the part. The axes read
//!
//! ```text
//! q_i = s_i (R p)_j(i) + o_i            R = [[cos t, -sin t], [sin t, cos t]]
//! ```
//!
//! for a point p of a part that is turned by t. When the reading of axis i increases, the tool
//! moves along s_i times the direction j(i) of the turned part. The axis reads o_i at the origin of
//! the part. A quarter turn is exact.
//!
//! | symbol | in the machine file | unit |
//! |---|---|---|
//! | t | `part_rotation_deg` | degrees |
//! | s_i, j(i) | `along` of the axis | - |
//! | o_i | `part_origin_mm` | mm |
//!
//! A stage that plans in the coordinates of the part needs limits in these coordinates
//! ([`Machine::limits_on_part`]). They are the largest box of (x, y) that the axes can follow in
//! every direction,
//!
//! ```text
//! |M| w <= limit of the axes            M = matrix of q;  w_x w_y largest
//! ```
//!
//! which is the limit of each axis itself for axes along x and y.

use crate::{
    ControllerKind, ControllerLines, ControllerModel, Invalid, Kinematics, Limits, MachineAxis,
    MachineFile, Transform, is_plausible_mm, kinematics::checked_axes, limits::AXES,
};

/// A machine: limits of its axes, their travel, and the position of the part on it.
#[derive(Clone, Debug, PartialEq)]
pub struct Machine {
    limits: Limits,
    travel_mm: [Option<[f64; 2]>; 2],
    axes: Vec<MachineAxis>,
    kinematics: Kinematics,
    part_origin_z_mm: f64,
    part_to_axes: Option<Transform>,
    controller: Option<ControllerModel>,
    controller_lines: ControllerLines,
}

/// Returns a machine whose axes x and y read the coordinates of the part and have no limit of travel.
impl From<Limits> for Machine {
    fn from(limits: Limits) -> Self {
        Self {
            axes: limits.axes().iter().map(|a| MachineAxis::linear(a, None)).collect(),
            limits,
            travel_mm: [None; 2],
            kinematics: Kinematics::Xy,
            part_origin_z_mm: 0.0,
            part_to_axes: None,
            controller: None,
            controller_lines: ControllerLines::default(),
        }
    }
}

impl Machine {
    /// Returns the machine of a file. Refuses limits, travels, kinematics, controllers and positions of the part that
    /// are not valid, see [`MachineFile`].
    pub fn new(file: MachineFile) -> Result<Self, Invalid> {
        let limits = file.clone().checked()?;
        let axes = checked_axes(&file)?;
        let kinematics = Kinematics::from_file(&file)?;
        // A machine without the axes x and y has no travel along them.
        let travel_mm =
            AXES.map(|name| axes.iter().find(|a| a.name == name).and_then(|a| a.travel));
        let part_origin_z_mm = file.part_origin_z_mm.unwrap_or_default();
        if !is_plausible_mm(part_origin_z_mm) {
            let remedy = "give what z reads where the tool touches the height 0 of the part, in mm";
            let problem = format!("is {part_origin_z_mm}");
            return Err(Invalid::whole("part_origin_z_mm", problem, remedy));
        }
        if file.part_origin_z_mm.is_some() && !axes.iter().any(|a| a.name == "z") {
            let remedy = "leave it out, or add the axis z and a `kinematics` that has it";
            return Err(Invalid::whole("part_origin_z_mm", "is given without an axis z", remedy));
        }
        let part_to_axes = part_to_axes(&file)?;
        let controller = file.controller.as_ref().map(|c| c.checked(&axes)).transpose()?;
        let lines = file.controller.as_ref().map(crate::ControllerFile::checked_lines);
        let controller_lines = lines.transpose()?.unwrap_or_default();
        Ok(Self {
            limits,
            travel_mm,
            axes,
            kinematics,
            part_origin_z_mm,
            part_to_axes,
            controller,
            controller_lines,
        })
    }

    /// Returns the lines that the machine file states around the motion, in the language of its own controller; all
    /// lists are empty without a controller.
    pub fn controller_lines(&self) -> &ControllerLines {
        &self.controller_lines
    }

    /// Returns the controller that the machine file states, or `None` if it states none.
    pub fn controller(&self) -> Option<&ControllerModel> {
        self.controller.as_ref()
    }

    /// Returns the rounding of positions, velocities and times in a program for `kind`: that of the machine's own
    /// controller if it is of this kind, else the defaults of the kind.
    pub fn controller_for(&self, kind: ControllerKind) -> ControllerModel {
        self.controller.filter(|c| c.kind == kind).unwrap_or_else(|| kind.model())
    }

    /// Returns the name of the machine.
    pub fn name(&self) -> &str {
        self.limits.name()
    }

    /// Returns the limits of the axes x and y. For a spindle machine, which has no such axes, they are the stated
    /// limits of the contact point.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Returns all axes in the order of the machine file, the linear ones first.
    pub fn axes(&self) -> &[MachineAxis] {
        &self.axes
    }

    /// Returns the kinematics: which axes move the tool over the part, and how.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Returns the reading of the axis z at which the tool, without tilt, touches the height 0 of the part, mm.
    pub fn part_origin_z_mm(&self) -> f64 {
        self.part_origin_z_mm
    }

    /// Returns the smallest and the largest position of the axes x and y, mm; `None` for an axis whose travel has no
    /// limit.
    pub fn travel_mm(&self) -> &[Option<[f64; 2]>; 2] {
        &self.travel_mm
    }

    /// Returns the transform from the coordinates of the part to the readings of the axes, or `None` if both are
    /// equal.
    pub fn part_to_axes(&self) -> Option<&Transform> {
        self.part_to_axes.as_ref()
    }

    /// Returns the limits along x and y of the part that the axes can follow in every direction at once: the largest
    /// box w of the module. For a spindle machine they are the stated ones.
    pub fn limits_on_part(&self) -> Limits {
        // Those of a spindle machine are along x and y of the part as stated.
        let is_spindle = matches!(self.kinematics, Kinematics::Spindle { .. });
        let Some(transform) = self.part_to_axes.as_ref().filter(|_| !is_spindle) else {
            return self.limits.clone();
        };
        let [velocity, acceleration] =
            [self.limits.max_velocity_mm_per_s(), self.limits.max_acceleration_mm_per_s2()].map(
                |limits| {
                    let largest = largest_box(transform.matrix(), limits.map(Some));
                    largest.map(|limit| limit.expect("it is limited on both axes"))
                },
            );
        let jerk = self.limits.axes().map(|a| a.max_jerk_mm_per_s3());
        let jerk = largest_box(transform.matrix(), jerk);
        self.limits.with_axes(velocity, acceleration, jerk)
    }
}

/// Returns the transform q(p) of the module from a point of the part to the readings of the axes; `None` if it is the
/// identity.
fn part_to_axes(file: &MachineFile) -> Result<Option<Transform>, Invalid> {
    let origin_mm = file.part_origin_mm.unwrap_or_default();
    if let Some(i) = origin_mm.iter().position(|v| !is_plausible_mm(*v)) {
        let remedy = "give what the axes read where the part has its origin, in mm";
        return Err(Invalid::at_index("part_origin_mm", i, format!("is {}", origin_mm[i]), remedy));
    }
    let turn_deg = file.part_rotation_deg.unwrap_or_default();
    if !(turn_deg.is_finite() && turn_deg.abs() <= 360.0) {
        let problem = format!("is {turn_deg}");
        return Err(Invalid::whole("part_rotation_deg", problem, "give degrees from -360 to 360"));
    }
    let [x, y] = [direction(file, 0)?, direction(file, 1)?];
    if x.0 == y.0 {
        let along = format!("are along {} and {}", written(x), written(y));
        let remedy = "let one axis go along x of the part and the other along y";
        return Err(Invalid::whole("axes", along, remedy));
    }
    let (sine, cosine) = sine_cosine(turn_deg);
    let turned = [[cosine, -sine], [sine, cosine]];
    let matrix = [x, y].map(|(j, sign)| turned[j].map(|v| sign * v + 0.0));
    if matrix == [[1.0, 0.0], [0.0, 1.0]] && origin_mm == [0.0; 2] {
        return Ok(None);
    }
    Transform::new(matrix, [0.0; 2], origin_mm, [[0.0; 6]; 6]).map(Some)
}

/// Returns the direction j (0 for x, 1 for y) and the sign s of the axis `i` as the module defines them. An axis that
/// states no direction, or that is not x or y, has the direction `i` and the sign 1.
fn direction(file: &MachineFile, i: usize) -> Result<(usize, f64), Invalid> {
    let axis = file.axes.get(i).filter(|axis| axis.name == AXES[i]);
    match axis.and_then(|axis| axis.along.as_deref()) {
        None => Ok((i, 1.0)),
        Some("x" | "+x") => Ok((0, 1.0)),
        Some("-x") => Ok((0, -1.0)),
        Some("y" | "+y") => Ok((1, 1.0)),
        Some("-y") => Ok((1, -1.0)),
        Some(other) => {
            let short: String = other.chars().take(20).collect();
            let remedy = "give \"+x\", \"-x\", \"+y\" or \"-y\": where the tool goes over the part";
            Err(Invalid::at_index("axes", i, format!("along is {short:?}"), remedy))
        }
    }
}

/// Returns a direction and its sign as a machine file states it, such as "-x".
fn written((j, sign): (usize, f64)) -> String {
    format!("{}{}", if sign < 0.0 { "-" } else { "+" }, AXES[j])
}

/// Returns sine and cosine of an angle in degrees, exact at quarter turns.
fn sine_cosine(angle_deg: f64) -> (f64, f64) {
    match angle_deg.rem_euclid(360.0) {
        0.0 => (0.0, 1.0),
        90.0 => (1.0, 0.0),
        180.0 => (0.0, -1.0),
        270.0 => (-1.0, 0.0),
        _ => angle_deg.to_radians().sin_cos(),
    }
}

/// Smallest magnitude of an element of the matrix M of the module, dimensionless; smaller elements count as zero. Much
/// smaller: a limit divided by the element overflows. Larger: a part of a limit is lost. Chosen: at 1e-100 it vanishes
/// at every plausible ratio of two limits.
const LEAST_PART: f64 = 1e-100;

/// Returns the box w with the largest product w_x w_y that keeps |M| w <= `limits`, for a matrix M of orthogonal rows.
/// `None` along an axis to which no limit applies.
fn largest_box(m: &[[f64; 2]; 2], limits: [Option<f64>; 2]) -> [Option<f64>; 2] {
    // a w_x + b w_y <= c
    let mut rows: Vec<[f64; 3]> = Vec::new();
    for (row, limit) in m.iter().zip(limits) {
        let [a, b] = row.map(|v| if v.abs() < LEAST_PART { 0.0 } else { v.abs() });
        rows.extend(limit.map(|c| [a, b, c]));
    }
    if rows.iter().any(|[a, b, _]| *a == 0.0 || *b == 0.0) {
        // Each axis goes along x or along y.
        return [0, 1]
            .map(|j| rows.iter().filter(|r| r[j] > 0.0).map(|r| r[2] / r[j]).reduce(f64::min));
    }
    if rows.is_empty() {
        return [None; 2];
    }
    // The largest product on one line, w_x = c / 2a, w_y = c / 2b, or the corner of both.
    let middle = rows.iter().map(|[a, b, c]| [c / (2.0 * a), c / (2.0 * b)]);
    let corner = match rows[..] {
        [[a, b, c], [d, e, f]] => {
            let determinant = a * e - b * d;
            Some([(c * e - b * f) / determinant, (a * f - c * d) / determinant])
        }
        _ => None,
    };
    let candidates = middle.chain(corner.filter(|w| w.iter().all(|v| v.is_finite() && *v > 0.0)));
    // Each candidate is scaled up to the limits. A comparison would depend on rounding where a
    // middle lies on its own line.
    let scaled = candidates.map(|w| {
        let most =
            rows.iter().map(|[a, b, c]| c / (a * w[0] + b * w[1])).fold(f64::INFINITY, f64::min);
        w.map(|v| most * v)
    });
    let best = scaled.max_by(|v, w| (v[0] * v[1]).total_cmp(&(w[0] * w[1])));
    best.map_or([None; 2], |w| w.map(Some))
}

/// Returns the sentence of a report for a plan on the machine `name`, which a pipeline chose because the user named
/// none.
pub fn assumed_machine(name: &str) -> String {
    format!(
        "no machine was named, so this is planned for {name}, a machine of the fixtures, with its limits; give machine=FILE \
         with the limits of your own"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ControllerFile, MachineFileAxis};

    fn file() -> MachineFile {
        let axis = |name: &str, factor: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 100.0 * factor,
            max_acceleration_mm_per_s2: 1000.0 * factor,
            max_jerk_mm_per_s3: Some(1e4 * factor),
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 1.0), axis("y", 0.6)];
        MachineFile { name: "m".into(), axes, ..MachineFile::default() }
    }

    fn along(x: &str, y: &str) -> MachineFile {
        let mut file = file();
        file.axes[0].along = Some(x.into());
        file.axes[1].along = Some(y.into());
        file
    }

    fn turned(angle_deg: f64) -> MachineFile {
        MachineFile { part_rotation_deg: Some(angle_deg), ..file() }
    }

    #[test]
    fn a_machine_without_the_new_keys_is_its_limits() {
        let machine = Machine::new(file()).unwrap();
        assert_eq!((machine.part_to_axes(), machine.travel_mm()), (None, &[None; 2]));
        assert_eq!(machine.limits_on_part(), file().checked().unwrap());
        // Keys that state the same have no effect either.
        let same = MachineFile { part_rotation_deg: Some(360.0), ..along("+x", "y") };
        assert_eq!(Machine::new(same).unwrap().part_to_axes(), None);
    }

    #[test]
    fn a_quarter_turn_is_an_exchange_of_the_axes() {
        for (angle_deg, x, y) in
            [(90.0, "-y", "+x"), (180.0, "-x", "-y"), (270.0, "+y", "-x"), (-90.0, "+y", "-x")]
        {
            let [a, b] = [turned(angle_deg), along(x, y)].map(|f| Machine::new(f).unwrap());
            assert_eq!(a, b, "{angle_deg}");
        }
        // x of the part comes to lie along y, y along -x: the axes read (10 - y, 20 + x).
        let file = MachineFile { part_origin_mm: Some([10.0, 20.0]), ..turned(90.0) };
        let machine = Machine::new(file).unwrap();
        assert_eq!(machine.part_to_axes().unwrap().point([1.0, 2.0]), [8.0, 21.0]);
        // Along x of the part the axis y moves.
        let limits = machine.limits_on_part();
        assert_eq!(limits.max_velocity_mm_per_s(), [60.0, 100.0]);
        assert_eq!(limits.axes()[1].max_jerk_mm_per_s3(), Some(1e4));
    }

    #[test]
    fn axes_are_exchanged_turned_over_and_turned() {
        // First turned by 30 degrees, then axis x counts against y of the turned part, axis y along x.
        let file = MachineFile {
            part_rotation_deg: Some(30.0),
            part_origin_mm: Some([1.0, 2.0]),
            ..along("-y", "+x")
        };
        let machine = Machine::new(file).unwrap();
        let q = machine.part_to_axes().unwrap().point([2.0, 0.0]);
        let expected = [1.0 - 1.0, 2.0 + 3.0_f64.sqrt()];
        // Rounding of coordinates of up to 4 mm.
        assert!((0..2).all(|i| (q[i] - expected[i]).abs() < 1e-15), "{q:?}");
        let mirrors = |x, y| Machine::new(along(x, y)).unwrap().part_to_axes().unwrap().mirrors();
        assert_eq!(
            (mirrors("+y", "+x"), mirrors("-y", "+x"), mirrors("-x", "+y")),
            (true, false, true)
        );
    }

    /// The largest box has its corner in the middle of the nearer of two lines, or at their
    /// intersection. Rounding puts either about 1e-16 beyond a line, which once made the box
    /// negative, or half as large.
    #[test]
    fn rounding_does_not_decide_on_the_box_of_a_turned_part() {
        for tenth in 1..900 {
            let angle_deg = 0.1 * f64::from(tenth);
            for speeds in [[117.0, 117.0], [61.0, 1223.0], [313.0, 234.0], [1014.0, 1014.0]] {
                let mut file = turned(angle_deg);
                for (axis, speed) in file.axes.iter_mut().zip(speeds) {
                    axis.max_velocity_mm_per_s = speed;
                }
                let machine = Machine::new(file).unwrap();
                let [wx, wy] = machine.limits_on_part().max_velocity_mm_per_s();
                let (s, c) = f64::to_radians(angle_deg).sin_cos();
                let used = [(c * wx + s * wy) / speeds[0], (s * wx + c * wy) / speeds[1]];
                let most = used[0].max(used[1]);
                // Rounding of sums of two products, relative to the limit.
                assert!((most - 1.0).abs() < 1e-12, "{angle_deg} {speeds:?}: {most} of a limit");
                // On the line of the nearer limit the product is c^2 / 4ab at its middle. No box
                // has a larger product, and the box at the intersection has a smaller one.
                let middle = |i: usize| speeds[i].powi(2) / (4.0 * s * c);
                let bound = middle(0).min(middle(1)) * (1.0 + 1e-12);
                let is_corner = used.iter().all(|u| (u - 1.0).abs() < 1e-12);
                assert!(wx > 0.0 && wy > 0.0 && wx * wy <= bound, "{angle_deg} {speeds:?}");
                // Rounding, as above, of an area that is the product of two sums.
                assert!(is_corner || wx * wy >= bound * (1.0 - 1e-11), "{angle_deg} {speeds:?}");
            }
        }
    }

    /// Every corner of the box is within the limits of the axes, and a search finds no box of a
    /// larger product.
    #[test]
    fn the_box_on_the_part_is_the_largest_that_the_axes_follow() {
        for angle_deg in [0.0, 1.0, 20.0, 31.0, 45.0, 60.0, 89.0, 130.0] {
            let machine = Machine::new(turned(angle_deg)).unwrap();
            let [wx, wy] = machine.limits_on_part().max_velocity_mm_per_s();
            let (s, c) = f64::to_radians(angle_deg).sin_cos();
            let (s, c) = (s.abs(), c.abs());
            // Largest velocity along y that the axes of 100 and 60 mm/s can reach together with x.
            let most = |x: f64| {
                let y = |a: f64, b: f64, limit: f64| match b > 1e-15 {
                    true => (limit - a * x) / b,
                    false if a * x > limit => f64::NEG_INFINITY,
                    false => f64::INFINITY,
                };
                y(c, s, 100.0).min(y(s, c, 60.0))
            };
            // Rounding.
            assert!(wy <= most(wx) * (1.0 + 1e-12), "{angle_deg}: {wx} {wy}");
            let tried = (0..=4000).map(|k| 0.05 * f64::from(k)).map(|x| x * most(x));
            let best = tried.fold(0.0, f64::max);
            // A search with steps finds no more than the largest; beyond it is rounding.
            assert!(wx * wy >= best * (1.0 - 1e-9), "{angle_deg}: {wx} x {wy} is less than {best}");
        }
        // A limit of one axis alone limits both directions, where it has a part in both.
        let mut one = turned(30.0);
        one.axes[1].max_jerk_mm_per_s3 = None;
        let jerk =
            Machine::new(one).unwrap().limits_on_part().axes().map(|a| a.max_jerk_mm_per_s3());
        // Below: rounding of 1e4.
        assert!((jerk[0].unwrap() - 5e3 / 0.75_f64.sqrt()).abs() < 1e-9, "{jerk:?}");
        assert!((jerk[1].unwrap() - 1e4).abs() < 1e-9, "{jerk:?}");
        let mut one = turned(90.0);
        one.axes[1].max_jerk_mm_per_s3 = None;
        let jerk =
            Machine::new(one).unwrap().limits_on_part().axes().map(|a| a.max_jerk_mm_per_s3());
        assert_eq!(jerk, [None, Some(1e4)]);
    }

    #[test]
    fn a_machine_states_its_controller_or_has_the_defaults() {
        let stated = ControllerFile {
            count_mm: Some(vec![1e-3; 2]),
            ..ControllerFile::new(ControllerKind::Galil)
        };
        let machine = Machine::new(MachineFile { controller: Some(stated), ..file() }).unwrap();
        let grids = machine.controller_for(ControllerKind::Galil).grids(machine.axes());
        assert!(grids.iter().all(|grid| grid.count == 1e-3), "{grids:?}");
        assert_eq!(machine.controller_for(ControllerKind::Xps), ControllerKind::Xps.model());
        let wrong =
            ControllerFile { tick_s: Some(0.0), ..ControllerFile::new(ControllerKind::Csv) };
        let said = Machine::new(MachineFile { controller: Some(wrong), ..file() }).unwrap_err();
        assert!(said.to_string().contains("controller.tick_s: is 0"), "{said}");
    }

    #[test]
    fn what_is_no_machine_is_refused_with_its_place() {
        let said = |file: MachineFile| Machine::new(file).unwrap_err().to_string();
        assert!(said(along("+z", "+y")).contains("axes[0]: along is \"+z\"; give \"+x\""));
        assert!(said(along("+x", "-x")).contains("axes: are along +x and -x; let one axis"));
        // The axis x goes along +x when nothing is said.
        let mut both = file();
        both.axes[1].along = Some("x".into());
        assert!(said(both).contains("axes: are along +x and +x"));
        for travel in [[1.0, 1.0], [2.0, 1.0], [f64::NAN, 1.0], [0.0, 1e9]] {
            let mut file = file();
            file.axes[1].travel_mm = Some(travel);
            assert!(said(file).contains("axes[1]: travel_mm is ["), "{travel:?}");
        }
        let away = MachineFile { part_origin_mm: Some([0.0, f64::INFINITY]), ..file() };
        assert!(said(away).contains("part_origin_mm[1]: is inf"));
        assert!(said(turned(400.0)).contains("part_rotation_deg: is 400; give degrees"));
        let mut slow = file();
        slow.axes[0].max_velocity_mm_per_s = 0.0;
        assert!(said(slow).contains("axes[0]: max_velocity_mm_per_s is 0"));
    }
}
