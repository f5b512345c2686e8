//! Assignment of the columns of a log to quantities.
//!
//! The user gives a column by its number, counted from 1, or by its name. Other columns are found by the
//! words of the names in the file, if exactly one column has them; the user is told which.

use planish_types::{
    Invalid,
    units::{Header, Quantity, Unit},
};
use serde::Serialize;

use super::{LogFormat, NAME, moment::Moment};

/// A quantity that a column of a log may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Time stamp of the sample.
    Time,
    /// Time stamp of the positions of y, if x and y have separate time stamps.
    TimeY,
    /// Measured position of x.
    X,
    /// Measured position of y.
    Y,
    /// Setpoint (commanded position) of x.
    SetpointX,
    /// Setpoint (commanded position) of y.
    SetpointY,
    /// Measured position of the axis with this index in [`Columns::axes`].
    Axis(usize),
    /// Beam current, in the unit of the log.
    Current,
    /// Switch of the tool: 1 if it removes, 0 if not.
    ToolOn,
}

impl Role {
    /// Returns true if the quantity is a measured or commanded position.
    pub fn is_position(self) -> bool {
        matches!(self, Self::X | Self::Y | Self::SetpointX | Self::SetpointY | Self::Axis(_))
    }

    /// Returns true if the quantity is a time stamp.
    pub fn is_time(self) -> bool {
        matches!(self, Self::Time | Self::TimeY)
    }

    /// Returns the name of the setting that states the column of the quantity, such as `setpoint_x`.
    pub fn setting(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::TimeY => "time_y",
            Self::X => "x",
            Self::Y => "y",
            Self::SetpointX => "setpoint_x",
            Self::SetpointY => "setpoint_y",
            Self::Axis(_) => "axis",
            Self::Current => "current",
            Self::ToolOn => "tool_on",
        }
    }

    /// Returns the kinds of unit that a column of this quantity may have. These are time or samples, angle or counts
    /// for a rotary axis, and length or counts for other positions.
    fn wanted(self, columns: &Columns) -> &'static [Quantity] {
        match self {
            Self::Time | Self::TimeY => &[Quantity::Time, Quantity::Samples],
            Self::Axis(k) if columns.axes[k].is_rotary => &[Quantity::Angle, Quantity::Counts],
            _ => &[Quantity::Length, Quantity::Counts],
        }
    }
}

/// An axis of a machine, and its column in the log.
#[derive(Clone, Debug, Serialize)]
pub struct AxisColumn {
    /// Name of the axis: x, y, z, r, a, b or c.
    pub name: String,
    /// True if the axis is a rotation, with positions in degrees.
    pub is_rotary: bool,
    /// Column of its positions, as in [`Columns`]; `None` leaves the choice to the name of the axis.
    pub column: Option<String>,
}

/// Columns that the user names, by number counted from 1, or by name. In HDF5 it is the path of a dataset, with `:K`
/// for column K of a matrix. `None` leaves the choice to the names in the log; in HDF5 the quantity is not read.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Columns {
    /// Time stamps of the samples.
    pub time: Option<String>,
    /// Time stamps of y, if they are not those of x.
    pub time_y: Option<String>,
    /// Measured positions of x.
    pub x: Option<String>,
    /// Measured positions of y.
    pub y: Option<String>,
    /// Setpoint (commanded position) of x.
    pub setpoint_x: Option<String>,
    /// Setpoint (commanded position) of y.
    pub setpoint_y: Option<String>,
    /// Beam current, which the removal rate follows.
    pub current: Option<String>,
    /// Switch of the tool, 0 or 1.
    pub tool_on: Option<String>,
    /// All axes of a machine, which replace x and y; empty for a log of x and y.
    pub axes: Vec<AxisColumn>,
}

impl Columns {
    /// Returns all quantities that a log may have, in the order in which columns are assigned to them. A list of axes
    /// replaces x, y and their setpoints.
    pub fn roles(&self) -> Vec<Role> {
        let mut roles = vec![Role::Time, Role::TimeY];
        match self.axes.len() {
            0 => roles.extend([Role::X, Role::Y, Role::SetpointX, Role::SetpointY]),
            axes => roles.extend((0..axes).map(Role::Axis)),
        }
        roles.extend([Role::Current, Role::ToolOn]);
        roles
    }

    /// Returns the name or number of the column that the user gave for a quantity, or `None`.
    pub fn requested(&self, role: Role) -> Option<&str> {
        let named = match role {
            Role::Time => &self.time,
            Role::TimeY => &self.time_y,
            Role::X => &self.x,
            Role::Y => &self.y,
            Role::SetpointX => &self.setpoint_x,
            Role::SetpointY => &self.setpoint_y,
            Role::Axis(k) => &self.axes[k].column,
            Role::Current => &self.current,
            Role::ToolOn => &self.tool_on,
        };
        named.as_deref()
    }

    /// Returns the name of a quantity in messages: that of its setting, such as `setpoint_x`, or the name of an axis.
    pub fn name(&self, role: Role) -> String {
        match role {
            Role::Axis(k) => self.axes[k].name.clone(),
            _ => role.setting().into(),
        }
    }

    /// Returns the remedy for a quantity whose column is not found.
    pub fn remedy(&self, role: Role) -> String {
        match role {
            Role::Axis(k) => format!("give `axis` {}=COLUMN", self.axes[k].name),
            _ => format!("give `{}`", role.setting()),
        }
    }
}

/// A column of a log, with the quantity that it holds.
#[derive(Clone, Debug)]
pub struct Column {
    /// Quantity that the column holds.
    pub role: Role,
    /// Name of the column, or its number as text.
    pub name: String,
    /// Unit that the log states for the column, or `None`.
    pub unit: Option<Unit>,
    /// Values of the samples (n), finite. Time stamps are stored as differences from the first one.
    pub values: Vec<f64>,
    /// First time stamp, in the unit of the column, if the stamps are numbers; 0 otherwise.
    pub first: f64,
    /// First time stamp, if the stamps are dates or times of day.
    pub first_moment: Option<Moment>,
    /// Unit of the last digit of the time stamps, in their unit; the rounding of a double in HDF5, and 0 for other
    /// quantities.
    pub resolution: f64,
    /// Index in [`Log::times`] of the separate time stamps of this quantity; `None` if it has those of the log.
    pub own_time: Option<usize>,
}

impl Column {
    /// Creates a column of numbers that has the time stamps of the log.
    pub fn of_values(role: Role, name: String, unit: Option<Unit>, values: Vec<f64>) -> Self {
        Self {
            role,
            name,
            unit,
            values,
            first: 0.0,
            first_moment: None,
            resolution: 0.0,
            own_time: None,
        }
    }
}

/// Columns that were read from a log, before any conversion of units.
#[derive(Clone, Debug)]
pub struct Log {
    /// Columns of the quantities, one each.
    pub columns: Vec<Column>,
    /// Columns of separate time stamps, which belong to some of the quantities.
    pub times: Vec<Column>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Returns the unit that `text` states for a quantity. `text` is the name of a column, or (if `is_word`) the unit
/// alone. Returns `None` if the name states no unit, and for a quantity that is neither a position nor a time.
///
/// # Errors
/// Refuses text in the place of a unit that is no known unit, and a unit of another quantity, such as mm/s for a
/// position.
pub fn stated_unit(
    role: Role,
    columns: &Columns,
    text: &str,
    is_word: bool,
) -> Result<Option<Unit>, Invalid> {
    if !(role.is_position() || role.is_time()) {
        return Ok(None);
    }
    let wanted = role.wanted(columns);
    let remedy =
        "correct the name of the column, or leave out its unit and give the unit by a flag";
    let unit = if is_word {
        Unit::read(text, wanted).map(Some).ok_or_else(|| planish_types::units::UnknownUnit {
            text: text.into(),
            word: text.into(),
        })
    } else {
        Header::read(text, wanted).map(|header| header.unit)
    };
    let unit = unit.map_err(|unknown| unknown.refused(role.setting(), remedy))?;
    match unit {
        Some(unit) if !wanted.contains(&unit.quantity()) => {
            let kind = if role.is_time() { "time" } else { "position" };
            let problem = format!("is {}, in {unit}, which is no unit of a {kind}", short(text));
            Err(Invalid::whole(role.setting(), problem, "give another column"))
        }
        unit => Ok(unit),
    }
}

/// Assignment of a column of a table to the quantity that it holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ColumnPlace {
    /// Quantity that the column holds.
    pub role: Role,
    /// Index of the column, counted from 0.
    pub index: usize,
}

/// Assigns the `count` columns of a table, with their `names` if it has some, to the quantities.
///
/// # Errors
/// Refuses a table without a column for a needed quantity (x and y, or every axis), the setpoint of one axis alone, and
/// one column for two quantities. Times of two axes may share a column. Refuses a stated column that is absent or not
/// unique, and a quantity that several columns may hold.
pub fn places(
    format: LogFormat,
    names: Option<&[String]>,
    count: usize,
    requested: &Columns,
) -> Result<Vec<ColumnPlace>, Invalid> {
    let mut places: Vec<ColumnPlace> = Vec::new();
    let mut missing = None;
    for role in requested.roles() {
        let index = match requested.requested(role) {
            Some(name) => Some(named(role, name, names, count)?),
            None => customary(format, role, names, count, requested)?,
        };
        if index.is_none() && matches!(role, Role::X | Role::Y | Role::Axis(_)) {
            missing.get_or_insert(role);
        }
        places.extend(index.map(|index| ColumnPlace { role, index }));
    }
    if let Some(role) = missing {
        let name = requested.name(role);
        let problem = format!("has no column that is known as {name}: {}", listed(names, count));
        let remedy = format!("{}, a name or a number counted from 1", requested.remedy(role));
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    let setpoints = places.iter().filter(|p| matches!(p.role, Role::SetpointX | Role::SetpointY));
    if setpoints.count() == 1 {
        let problem = format!("has the setpoint of one axis: {}", listed(names, count));
        return Err(Invalid::whole(NAME, problem, "give `setpoint_x` and `setpoint_y`"));
    }
    for (i, place) in places.iter().enumerate() {
        // One column may be the time of both axes.
        if let Some(other) = places[..i]
            .iter()
            .find(|p| p.index == place.index && !(p.role.is_time() && place.role.is_time()))
        {
            let other = requested.name(other.role);
            let problem = format!("is column {} as {other} is", place.index + 1);
            return Err(Invalid::whole(place.role.setting(), problem, "give another column"));
        }
    }
    Ok(places)
}

/// Returns the number of the columns and the first 20 of their names, for a message.
fn listed(names: Option<&[String]>, count: usize) -> String {
    match names {
        Some(names) => {
            let shown: Vec<String> = names.iter().take(20).map(|n| short(n)).collect();
            format!("{count} columns, {}", shown.join(", "))
        }
        None => format!("{count} columns without names"),
    }
}

/// Returns the first 40 characters of a name, without control characters, in quotation marks, for a message.
pub(super) fn short(name: &str) -> String {
    let shown: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
    format!("\"{shown}\"")
}

/// Returns the index of the column that the user stated as `name`: its name in any case, or its number from 1 to
/// `count`. Refuses text that is neither, and a name that several columns have.
fn named(role: Role, name: &str, names: Option<&[String]>, count: usize) -> Result<usize, Invalid> {
    let all = names.unwrap_or_default().iter().enumerate();
    let matching: Vec<usize> =
        all.filter(|(_, n)| n.trim().eq_ignore_ascii_case(name.trim())).map(|n| n.0).collect();
    match (&matching[..], name.trim().parse::<usize>()) {
        ([only], _) => Ok(*only),
        ([], Ok(number)) if (1..=count).contains(&number) => Ok(number - 1),
        ([], _) => {
            let problem = format!("is {}, the log has {}", short(name), listed(names, count));
            Err(Invalid::whole(role.setting(), problem, "give a name or a number counted from 1"))
        }
        _ => {
            let numbers: Vec<String> = matching.iter().map(|i| format!("{}", i + 1)).collect();
            let problem =
                format!("is {}, which columns {} are called", short(name), numbers.join(" and "));
            Err(Invalid::whole(role.setting(), problem, "give the number of the column"))
        }
    }
}

/// Returns the index of the column that its name, or the usual order of an XPS, assigns to a quantity; `None` without
/// one. Refuses a quantity that several columns may hold.
fn customary(
    format: LogFormat,
    role: Role,
    names: Option<&[String]>,
    count: usize,
    requested: &Columns,
) -> Result<Option<usize>, Invalid> {
    let Some(names) = names else {
        // `setpoint;actual;` per axis
        let order = [Role::SetpointX, Role::X, Role::SetpointY, Role::Y];
        let is_default =
            requested.roles().into_iter().all(|role| requested.requested(role).is_none());
        let in_order = format == LogFormat::Xps && is_default && count == order.len();
        return Ok(order.iter().position(|r| *r == role).filter(|_| in_order));
    };
    let axis = requested.axis(role);
    let mut matching: Vec<usize> =
        (0..names.len()).filter(|i| is_known_as(format, role, axis, &names[*i])).collect();
    // Several columns of times of the same name belong to channels, and the first is that of the log.
    if role == Role::Time && matching.iter().all(|i| names[*i] == names[matching[0]]) {
        matching.truncate(1);
    }
    match matching[..] {
        [only] => Ok(Some(only)),
        [] if format == LogFormat::Xps => Ok(in_order_of_positioners(role, names)),
        [] => Ok(None),
        _ => {
            let shown: Vec<String> = matching.iter().take(5).map(|i| short(&names[*i])).collect();
            let problem = format!("could be {}", shown.join(" or "));
            Err(Invalid::whole(role.setting(), problem, requested.remedy(role)))
        }
    }
}

impl Columns {
    /// Returns the name of the axis whose position the quantity is; empty for other quantities.
    fn axis(&self, role: Role) -> &str {
        match role {
            Role::X | Role::SetpointX => "x",
            Role::Y | Role::SetpointY => "y",
            Role::Axis(k) => &self.axes[k].name,
            _ => "",
        }
    }
}

/// Returns the words of a column's name in lower case, without its unit; a capital letter within a word begins a new
/// one. `X Position Feedback (mm)` gives x, position, feedback; `Group1.X.SetpointPosition` gives group1, x, setpoint,
/// position.
fn words(name: &str) -> Vec<String> {
    let plain = Header::read(name, &[Quantity::Length, Quantity::Time, Quantity::Angle]);
    let plain = plain.map_or_else(|unknown| unknown.text, |header| header.name);
    let mut words = vec![String::new()];
    let mut before = ' ';
    for c in plain.split(['(', '[', '{']).next().unwrap_or_default().chars() {
        let new_word = c.is_uppercase() && before.is_lowercase();
        if !c.is_alphanumeric() || new_word {
            words.push(String::new());
        }
        if c.is_alphanumeric() {
            words.last_mut().expect("there is one").extend(c.to_lowercase());
        }
        before = c;
    }
    words.retain(|word| !word.is_empty());
    words
}

/// Words that name a time, in English, German and French.
const TIMES: [&str; 8] =
    ["t", "time", "timestamp", "stamp", "zeit", "zeitstempel", "temps", "uhrzeit"];

/// Returns true if one of the words of the name is a word for time (`TIMES`).
pub fn is_time(name: &str) -> bool {
    let words = words(name);
    words.iter().any(|word| TIMES.contains(&word.as_str())) || words == ["sample", "time"]
}

/// Returns the names of axes other than x and y (z, a, b, c, u, v, w, r, theta, phi) for which a table has columns of
/// measured positions.
pub fn further_axes(format: LogFormat, names: &[String]) -> Vec<String> {
    let mut axes = Vec::new();
    for axis in ["z", "a", "b", "c", "u", "v", "w", "r", "theta", "phi"] {
        if names.iter().any(|name| {
            words(name).iter().any(|word| word == axis) && is_known_as(format, Role::X, axis, name)
        }) {
            axes.push(axis.to_string());
        }
    }
    axes
}

/// Returns true if a column called `name` holds the quantity `role`, by the words of the name or the operands of Galil.
/// `axis` is the name of the axis of a position, and empty for other quantities.
fn is_known_as(format: LogFormat, role: Role, axis: &str, name: &str) -> bool {
    if format == LogFormat::Galil {
        let galil = match (role, axis) {
            (Role::X, "x") => "_TPA",
            (Role::Y, "y") => "_TPB",
            (Role::SetpointX, _) => "_RPA",
            (Role::SetpointY, _) => "_RPB",
            _ => "",
        };
        if name.trim().eq_ignore_ascii_case(galil) {
            return true;
        }
    }
    let words = words(name);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match role {
        Role::Time => return matches!(words[..], [one] if TIMES.contains(&one)),
        Role::TimeY => return false,
        Role::ToolOn => return words == ["tool", "on"],
        Role::Current => {
            return words == ["current"]
                || (words.contains(&"current") && has_one(&words, &["beam", "ion"]));
        }
        _ => {}
    }
    let others: Vec<&str> = words.iter().copied().filter(|word| *word != axis).collect();
    if !words.contains(&axis) || has_one(&others, &NO_POSITIONS) || has_one(&others, &TIMES) {
        return false;
    }
    let is_setpoint = has_one(&words, &SETPOINTS);
    match role {
        Role::SetpointX | Role::SetpointY => is_setpoint,
        _ if is_setpoint => false,
        _ => {
            // CurrentPosition is where an axis is; a current alone is in amperes.
            let is_last = words.last() == Some(&axis);
            let is_known = words.len() == 2 || words.contains(&"current") || is_last;
            words.len() == 1
                || has_one(&words, &MEASURED)
                || (has_one(&words, &["position", "pos"]) && is_known)
        }
    }
}

/// Words of a name that is not that of a position, such as velocity or error.
const NO_POSITIONS: [&str; 11] = [
    "velocity",
    "acceleration",
    "error",
    "speed",
    "jerk",
    "torque",
    "v",
    "a",
    "vel",
    "acc",
    "force",
];

/// Words in the name of a column that make it a setpoint.
const SETPOINTS: [&str; 9] =
    ["setpoint", "command", "commanded", "cmd", "reference", "target", "set", "soll", "demand"];

/// Words in the name of a column that make it a measured position.
const MEASURED: [&str; 8] =
    ["actual", "act", "feedback", "fbk", "encoder", "enc", "measured", "ist"];

/// Returns true if at least one of `words` is in `list`.
fn has_one(words: &[&str], list: &[&str]) -> bool {
    words.iter().any(|word| list.contains(word))
}

/// Returns the index of the column of a quantity by the order of the positioners, whose names are not x and y. The
/// first positioner is x, the second y. Returns `None` unless two columns have the ending of the quantity, and for
/// quantities other than positions of x and y.
fn in_order_of_positioners(role: Role, names: &[String]) -> Option<usize> {
    let (ending, which) = match role {
        Role::X => ("CurrentPosition", 0),
        Role::Y => ("CurrentPosition", 1),
        Role::SetpointX => ("SetpointPosition", 0),
        Role::SetpointY => ("SetpointPosition", 1),
        _ => return None,
    };
    let positioners = (0..names.len()).filter(|i| names[*i].trim().ends_with(ending));
    let positioners: Vec<usize> = positioners.collect();
    if positioners.len() == 2 { Some(positioners[which]) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(of: &[&str]) -> Vec<String> {
        of.iter().map(|n| n.to_string()).collect()
    }

    fn found(format: LogFormat, of: &[&str]) -> Vec<(Role, usize)> {
        let names = names(of);
        let places = places(format, Some(&names), of.len(), &Columns::default()).unwrap();
        places.iter().map(|p| (p.role, p.index)).collect()
    }

    #[test]
    fn the_names_that_controllers_give() {
        use Role::*;
        let four = |t: usize| vec![(X, t + 1), (Y, t + 3), (SetpointX, t), (SetpointY, t + 2)];
        let xps = [
            "G.X.SetpointPosition",
            "G.X.CurrentPosition",
            "G.Y.SetpointPosition",
            "G.Y.CurrentPosition",
        ];
        assert_eq!(found(LogFormat::Xps, &xps), four(0));
        let xps = [
            "A.Pos.SetpointPosition",
            "A.Pos.CurrentPosition",
            "B.Pos.SetpointPosition",
            "B.Pos.CurrentPosition",
        ];
        assert_eq!(found(LogFormat::Xps, &xps), four(0));
        let aerotech = [
            "Time (ms)",
            "X Position Command (mm)",
            "X Position Feedback (mm)",
            "Y Position Command (mm)",
            "Y Position Feedback (mm)",
            "X Velocity Feedback (mm/s)",
        ];
        assert_eq!(found(LogFormat::Aerotech, &aerotech), [vec![(Time, 0)], four(1)].concat());
        assert_eq!(found(LogFormat::Galil, &["_RPA", "_TPA", "_RPB", "_TPB"]), four(0));
        let csv = ["t_s", "x_mm", "y_mm", "vx_mm_per_s", "beam_current_uA", "tool_on"];
        let expected = [(Time, 0), (X, 1), (Y, 2), (Current, 4), (ToolOn, 5)];
        assert_eq!(found(LogFormat::Csv, &csv), expected);
        let twincat = ["Zeit [ms]", "ActPos_X", "ActPos_Y", "SetPos_X", "SetPos_Y", "Time"];
        assert!(places(LogFormat::Csv, Some(&names(&twincat)), 6, &Columns::default()).is_err());
        let german = &twincat[..5];
        let expected = [(Time, 0), (X, 1), (Y, 2), (SetpointX, 3), (SetpointY, 4)];
        assert_eq!(found(LogFormat::Csv, german), expected);
        let ros = ["%time", "field.header.seq", "field.pose.position.x", "field.pose.position.y"];
        assert_eq!(found(LogFormat::Csv, &ros), [(Time, 0), (X, 2), (Y, 3)]);
        let five = ["t_s", "x_mm", "y_mm", "Z Position (mm)", "a_deg", "B Feedback (rad)"];
        assert_eq!(found(LogFormat::Csv, &five), [(Time, 0), (X, 1), (Y, 2)]);
        assert_eq!(further_axes(LogFormat::Csv, &names(&five)), ["z", "a", "b"]);
        let axis =
            |name: &str| AxisColumn { name: name.into(), is_rotary: name > "z", column: None };
        let asked = Columns { axes: ["x", "b", "a"].map(axis).to_vec(), ..Columns::default() };
        let of_axes = places(LogFormat::Csv, Some(&names(&five)), 6, &asked).unwrap();
        let of_axes: Vec<_> = of_axes.iter().map(|p| (p.role, p.index)).collect();
        assert_eq!(of_axes, [(Time, 0), (Axis(0), 1), (Axis(1), 5), (Axis(2), 4)]);
    }

    #[test]
    fn what_is_not_clear_is_asked_for() {
        let refused = |of: &[&str], asked: &Columns| {
            let names = names(of);
            places(LogFormat::Csv, Some(&names), of.len(), asked).unwrap_err().to_string()
        };
        let none = Columns::default();
        let said = refused(&["x actual", "x encoder", "y"], &none);
        assert!(said.contains("x: could be \"x actual\" or \"x encoder\"; give `x`"), "{said}");
        assert!(refused(&["a", "b"], &none).contains("no column that is known as x"));
        assert!(refused(&["x", "y", "x setpoint"], &none).contains("setpoint of one axis"));
        let same = Columns { x: Some("2".into()), ..Columns::default() };
        assert!(
            refused(&["x", "y"], &same).contains("column 2"),
            "{}",
            refused(&["x", "y"], &same)
        );
        let far = Columns { x: Some("3".into()), ..Columns::default() };
        assert!(refused(&["x", "y"], &far).contains("x: is \"3\", the log has 2 columns"));
    }

    #[test]
    fn a_name_states_its_unit() {
        let none = Columns::default();
        let stated = |role, name: &str| stated_unit(role, &none, name, false);
        let unit = |role, name: &str| stated(role, name).unwrap().map(|unit| unit.to_string());
        assert_eq!(unit(Role::X, "x_mm").as_deref(), Some("mm"));
        assert_eq!(unit(Role::Time, "Time [ms]").as_deref(), Some("ms"));
        assert_eq!(unit(Role::Time, "time_min").as_deref(), Some("min"));
        assert_eq!(unit(Role::X, "X Position (\u{b5}m)").as_deref(), Some("um"));
        assert_eq!(unit(Role::X, "x (micron)").as_deref(), Some("um"));
        assert_eq!((unit(Role::X, "x"), unit(Role::X, "x_actual")), (None, None));
        assert_eq!(unit(Role::Current, "current (furlong)"), None);
        let said = stated(Role::X, "X (mm/s)").unwrap_err().to_string();
        assert!(said.contains("in mm/s, which is no unit of a position"), "{said}");
        let said = stated(Role::X, "x (furlong)").unwrap_err().to_string();
        assert!(said.contains("\"furlong\" in \"x (furlong)\", which is no known unit"), "{said}");
    }
}
