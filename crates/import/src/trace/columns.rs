//! Assignment of the columns of a log to quantities.
//!
//! The user gives a column by its number, counted from 1, or by its name. Other columns are found by the
//! words of the names in the file, if exactly one column has them; the user is told which.

use planish_types::Invalid;
use serde::Serialize;

use super::{LogFormat, NAME, PositionUnit, TimeUnit};

/// A quantity of a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Time stamp.
    Time,
    /// Measured position of x.
    X,
    /// Measured position of y.
    Y,
    /// Setpoint of x.
    SetpointX,
    /// Setpoint of y.
    SetpointY,
    /// Beam current.
    Current,
    /// Switch of the tool: 1 if it removes, 0 if not.
    ToolOn,
}

impl Role {
    /// All quantities, in the order in which columns are assigned.
    pub const ALL: [Self; 7] = [
        Self::Time,
        Self::X,
        Self::Y,
        Self::SetpointX,
        Self::SetpointY,
        Self::Current,
        Self::ToolOn,
    ];

    /// Returns true if the quantity is a length.
    pub fn is_position(self) -> bool {
        matches!(self, Self::X | Self::Y | Self::SetpointX | Self::SetpointY)
    }

    /// Name of the setting that gives the column of the quantity.
    pub fn setting(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::X => "x",
            Self::Y => "y",
            Self::SetpointX => "setpoint_x",
            Self::SetpointY => "setpoint_y",
            Self::Current => "current",
            Self::ToolOn => "tool_on",
        }
    }
}

/// The columns that the user names: by number, counted from 1, or by name; in HDF5 the path of a dataset, with
/// `:K` for column K of a matrix.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Columns {
    /// Time stamps.
    pub time: Option<String>,
    /// Measured position of x.
    pub x: Option<String>,
    /// Measured position of y.
    pub y: Option<String>,
    /// Setpoint of x.
    pub setpoint_x: Option<String>,
    /// Setpoint of y.
    pub setpoint_y: Option<String>,
    /// Beam current.
    pub current: Option<String>,
    /// Switch of the tool.
    pub tool_on: Option<String>,
}

impl Columns {
    /// Name or number that the user gave for a quantity.
    pub fn of(&self, role: Role) -> Option<&str> {
        let named = match role {
            Role::Time => &self.time,
            Role::X => &self.x,
            Role::Y => &self.y,
            Role::SetpointX => &self.setpoint_x,
            Role::SetpointY => &self.setpoint_y,
            Role::Current => &self.current,
            Role::ToolOn => &self.tool_on,
        };
        named.as_deref()
    }
}

/// A column that was read.
#[derive(Clone, Debug)]
pub struct Column {
    /// Quantity of the column.
    pub role: Role,
    /// Name of the column, or its number.
    pub name: String,
    /// Unit that the log states for a position.
    pub position_unit: Option<PositionUnit>,
    /// Unit that the log states for a time.
    pub time_unit: Option<TimeUnit>,
    /// Values (n), finite.
    pub values: Vec<f64>,
}

/// Column of a quantity in a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// Quantity of the column.
    pub role: Role,
    /// Column, counted from 0.
    pub index: usize,
}

/// Columns of the quantities in a table of `count` columns, with `names` if it has some.
pub fn places(
    format: LogFormat,
    names: Option<&[String]>,
    count: usize,
    asked: &Columns,
) -> Result<Vec<Place>, Invalid> {
    let mut found = Vec::new();
    for role in Role::ALL {
        let index = match asked.of(role) {
            Some(name) => Some(named(role, name, names, count)?),
            None => customary(format, role, names, count, asked)?,
        };
        found.extend(index.map(|index| Place { role, index }));
    }
    let has = |role: Role| found.iter().any(|p| p.role == role);
    for role in [Role::X, Role::Y] {
        if !has(role) {
            let problem = format!(
                "has no column that is known as {}: {}",
                role.setting(),
                listed(names, count)
            );
            let remedy = format!("give `{}`, a name or a number counted from 1", role.setting());
            return Err(Invalid::whole(NAME, problem, remedy));
        }
    }
    if has(Role::SetpointX) != has(Role::SetpointY) {
        let problem = format!("has the setpoint of one axis: {}", listed(names, count));
        return Err(Invalid::whole(NAME, problem, "give `setpoint_x` and `setpoint_y`"));
    }
    for (i, place) in found.iter().enumerate() {
        if let Some(other) = found[..i].iter().find(|p| p.index == place.index) {
            let problem = format!("is column {} as {} is", place.index + 1, other.role.setting());
            return Err(Invalid::whole(place.role.setting(), problem, "give another column"));
        }
    }
    Ok(found)
}

/// The columns of a table, for a message.
fn listed(names: Option<&[String]>, count: usize) -> String {
    match names {
        Some(names) => {
            let shown: Vec<String> = names.iter().take(20).map(|n| short(n)).collect();
            format!("{count} columns, {}", shown.join(", "))
        }
        None => format!("{count} columns without names"),
    }
}

/// A name for a message.
pub(super) fn short(name: &str) -> String {
    let shown: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
    format!("\"{shown}\"")
}

/// The column that the user named.
fn named(role: Role, name: &str, names: Option<&[String]>, count: usize) -> Result<usize, Invalid> {
    let same = |n: &String| n.trim().eq_ignore_ascii_case(name.trim());
    let matching: Vec<usize> = names
        .unwrap_or_default()
        .iter()
        .enumerate()
        .filter(|(_, n)| same(n))
        .map(|n| n.0)
        .collect();
    match (&matching[..], name.trim().parse::<usize>()) {
        ([only], _) => Ok(*only),
        ([], Ok(number)) if (1..=count).contains(&number) => Ok(number - 1),
        ([], _) => {
            let problem = format!("is {}, the log has {}", short(name), listed(names, count));
            Err(Invalid::whole(role.setting(), problem, "give a name or a number counted from 1"))
        }
        _ => {
            let problem = format!("is {}, which several columns are called", short(name));
            Err(Invalid::whole(role.setting(), problem, "give the number of the column"))
        }
    }
}

/// The column that is known by its name, or by the order that a controller has.
fn customary(
    format: LogFormat,
    role: Role,
    names: Option<&[String]>,
    count: usize,
    asked: &Columns,
) -> Result<Option<usize>, Invalid> {
    let nothing_asked = Role::ALL.iter().all(|role| asked.of(*role).is_none());
    let Some(names) = names else {
        // `setpoint;actual;` per axis
        let order = [Role::SetpointX, Role::X, Role::SetpointY, Role::Y];
        let in_order = format == LogFormat::Xps && nothing_asked && count == order.len();
        return Ok(order.iter().position(|r| *r == role).filter(|_| in_order));
    };
    let known = |name: &&String| is_known_as(format, role, name);
    let matching: Vec<usize> =
        names.iter().enumerate().filter(|(_, name)| known(name)).map(|found| found.0).collect();
    match matching[..] {
        [only] => Ok(Some(only)),
        [] if format == LogFormat::Xps => Ok(in_order_of_positioners(role, names)),
        [] => Ok(None),
        _ => {
            let shown: Vec<String> = matching.iter().take(5).map(|i| short(&names[*i])).collect();
            let problem = format!("could be {}", shown.join(" or "));
            let remedy = format!("give `{}`", role.setting());
            Err(Invalid::whole(role.setting(), problem, remedy))
        }
    }
}

/// Words of a name in lower case, without a unit: `X Position Feedback (mm)` is x, position, feedback, and
/// `Group1.X.SetpointPosition` is group1, x, setpoint, position.
fn words(name: &str) -> Vec<String> {
    let name = name.split(['(', '[']).next().unwrap_or_default();
    let mut words = vec![String::new()];
    let mut before = ' ';
    for c in name.chars() {
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
    if words.len() > 1 && unit_named(&words[words.len() - 1]).is_some() {
        words.pop();
    }
    words
}

/// Returns true if a column of this name holds the quantity.
fn is_known_as(format: LogFormat, role: Role, name: &str) -> bool {
    if format == LogFormat::Galil {
        let galil = match role {
            Role::X => "_TPA",
            Role::Y => "_TPB",
            Role::SetpointX => "_RPA",
            Role::SetpointY => "_RPB",
            _ => "",
        };
        if name.trim().eq_ignore_ascii_case(galil) {
            return true;
        }
    }
    let words = words(name);
    let has = |any: &[&str]| words.iter().any(|word| any.contains(&word.as_str()));
    let axis = match role {
        Role::Time => return matches!(&words[..], [one] if one == "t" || one == "time"),
        Role::ToolOn => return words == ["tool", "on"],
        Role::Current => {
            let beam = ["beam", "ion"];
            return words == ["current"] || (has(&["current"]) && has(&beam));
        }
        Role::X | Role::SetpointX => "x",
        Role::Y | Role::SetpointY => "y",
    };
    let other = ["velocity", "acceleration", "error", "speed", "jerk", "torque", "v", "a"];
    if !has(&[axis]) || has(&other) {
        return false;
    }
    let setpoint = has(&["setpoint", "command", "commanded", "cmd", "reference", "target"]);
    let position = has(&["position", "pos"]);
    match role {
        Role::SetpointX | Role::SetpointY => setpoint,
        _ if setpoint => false,
        _ => {
            // CurrentPosition is where an axis is; a current alone is in amperes.
            let actual = has(&["actual", "feedback", "fbk", "encoder", "measured"]);
            words.len() == 1 || actual || (position && (words.len() == 2 || has(&["current"])))
        }
    }
}

/// Column of a quantity by the order of positioners with other names than x and y: the first is x, the
/// second y.
fn in_order_of_positioners(role: Role, names: &[String]) -> Option<usize> {
    let (ending, which) = match role {
        Role::X => ("CurrentPosition", 0),
        Role::Y => ("CurrentPosition", 1),
        Role::SetpointX => ("SetpointPosition", 0),
        Role::SetpointY => ("SetpointPosition", 1),
        _ => return None,
    };
    let mut of: Vec<usize> = Vec::new();
    of.extend(names.iter().enumerate().filter(|(_, n)| n.trim().ends_with(ending)).map(|n| n.0));
    (of.len() == 2).then(|| of[which])
}

/// The unit at the end of a name: `x_mm`, `Position (mm)`, `t [ms]`.
pub fn stated_unit(name: &str) -> Option<&str> {
    let name = name.trim();
    let bracketed = name.strip_suffix([')', ']']).and_then(|n| n.rsplit(['(', '[']).next());
    let unit = bracketed.or_else(|| name.rsplit_once('_').map(|n| n.1))?;
    unit_named(unit).map(|_| unit)
}

/// A unit of length or time that a log names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Named {
    /// Unit of positions.
    Position(PositionUnit),
    /// Unit of times.
    Time(TimeUnit),
}

/// The unit of this name.
pub fn unit_named(name: &str) -> Option<Named> {
    use Named::{Position, Time};
    Some(match name.trim().to_lowercase().replace(['\u{b5}', '\u{3bc}'], "u").as_str() {
        "m" => Position(PositionUnit::M),
        "mm" => Position(PositionUnit::Mm),
        "um" => Position(PositionUnit::Um),
        "nm" => Position(PositionUnit::Nm),
        "count" | "counts" | "cts" => Position(PositionUnit::Count),
        "s" | "sec" => Time(TimeUnit::S),
        "ms" | "msec" => Time(TimeUnit::Ms),
        "us" | "usec" => Time(TimeUnit::Us),
        _ => return None,
    })
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
        let unit = |name: &str| stated_unit(name).and_then(unit_named);
        assert_eq!(unit("x_mm"), Some(Named::Position(PositionUnit::Mm)));
        assert_eq!(unit("Time [ms]"), Some(Named::Time(TimeUnit::Ms)));
        assert_eq!(unit("X Position (\u{b5}m)"), Some(Named::Position(PositionUnit::Um)));
        assert_eq!((unit("x"), unit("x_actual"), unit("X (mm/s)")), (None, None, None));
    }
}
