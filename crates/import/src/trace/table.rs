//! Text in columns: one line per sample, fields separated by semicolon, tab, comma or white space.
//!
//! There may be lines above the samples that are no rows of numbers: comments and the names of the columns.
//! The names are the last of these lines with as many fields as a sample has. Empty cells may stand at the
//! end, if one array of a Galil is shorter than another. The log ends with the first sample that lacks a
//! cell of a column that is read.

use planish_types::{Invalid, budget};

use super::{
    LogFormat, NAME, TimeUnit,
    columns::{Column, Columns, Named, Role, places, short, stated_unit, unit_named},
    moment,
};
use crate::{
    budget::{BYTES_PER_SAMPLE, MOST_SAMPLES, too_many},
    text,
};

/// Largest number of lines above the samples. Larger: more time on text that is no log. Smaller: refuses
/// logs with long headers.
const MOST_LINES_ABOVE: usize = 200;

/// Largest number of columns that are counted in a table. Larger: more time and memory for a hostile file.
/// Smaller: columns further to the right are not found.
const MOST_COLUMNS: usize = 1000;

/// Separator of the fields of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Separator {
    Character(char),
    Blank,
}

impl Separator {
    fn of(line: &str) -> Self {
        let found = [';', '\t', ','].into_iter().find(|c| line.contains(*c));
        found.map_or(Self::Blank, Self::Character)
    }

    /// Calls `each` with the fields of a line until it returns false; a separator at the end closes the line.
    #[inline]
    fn fields<'a>(self, line: &'a str, mut each: impl FnMut(usize, &'a str) -> bool) {
        let line = line.trim_matches([' ', '\r']);
        match self {
            Self::Character(c) => {
                let line = line.strip_suffix(c).unwrap_or(line);
                for (i, field) in line.split(c).enumerate() {
                    if !each(i, field.trim_matches([' ', '\t', '"'])) {
                        return;
                    }
                }
            }
            Self::Blank => {
                for (i, field) in line.split_ascii_whitespace().enumerate() {
                    if !each(i, field) {
                        return;
                    }
                }
            }
        }
    }

    fn count(self, line: &str) -> usize {
        let mut count = 0;
        self.fields(line, |_, _| {
            count += 1;
            count < MOST_COLUMNS
        });
        count
    }

    fn names(self, line: &str) -> Vec<String> {
        let line = line.trim().trim_start_matches(['#', '%', '!', '/']).trim();
        let mut names = Vec::new();
        self.fields(line, |_, field| {
            names.push(field.trim_matches('"').to_string());
            names.len() < MOST_COLUMNS
        });
        names
    }
}

/// Returns true if a line is a row of numbers; cells may be empty, but not all of them.
fn is_row(line: &str) -> bool {
    let (mut numbers, mut others) = (0, 0);
    Separator::of(line).fields(line, |_, field| {
        let is_number = field.parse::<f64>().is_ok() || moment::seconds(field).is_some();
        numbers += usize::from(is_number);
        others += usize::from(!field.is_empty() && !is_number);
        others == 0
    });
    numbers > 0 && others == 0
}

/// Index of the first row, and the names of the columns above it.
fn above(lines: &[&str]) -> Result<(usize, Option<Vec<String>>), Invalid> {
    let looked_at = &lines[..lines.len().min(MOST_LINES_ABOVE)];
    let text = looked_at.iter().rposition(|l| !l.trim().is_empty() && !is_row(l));
    let first = text.map_or(0, |i| i + 1);
    let first = (first..lines.len()).find(|i| !lines[*i].trim().is_empty());
    let Some(first) = first.filter(|i| is_row(lines[*i])) else {
        let problem = format!("has no row of numbers in its first {} lines", looked_at.len());
        return Err(Invalid::whole(NAME, problem, "give text with a line per sample"));
    };
    let separator = Separator::of(lines[first]);
    let count = separator.count(lines[first]);
    let names = lines[..first].iter().rev().filter(|l| !l.trim().is_empty() && !is_row(l));
    let names = names.map(|l| separator.names(l)).find(|names| names.len() == count);
    Ok((first, names))
}

/// Reads the columns that are asked for, or known by their names.
pub fn read(format: LogFormat, bytes: &[u8], asked: &Columns) -> Result<Vec<Column>, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    let mut head: Vec<&str> = Vec::new();
    head.extend(text.lines().take(MOST_LINES_ABOVE + 1));
    let (first, names) = above(&head)?;
    let separator = Separator::of(head[first]);
    let count = separator.count(head[first]);
    let mut places = places(format, names.as_deref(), count, asked)?;
    places.sort_by_key(|place| place.index);
    // The first row says whether the times are numbers or moments.
    let mut are_moments = vec![false; count];
    separator.fields(head[first], |i, field| {
        are_moments[i] = field.parse::<f64>().is_err() && moment::seconds(field).is_some();
        i + 1 < count
    });
    let wanted: Vec<Wanted> = (places.iter())
        .map(|place| Wanted {
            index: place.index,
            is_moment: place.role == Role::Time && are_moments[place.index],
        })
        .collect();

    let most = most_samples();
    let mut values: Vec<Vec<f64>> = vec![Vec::new(); wanted.len()];
    let mut ended = None;
    for (i, line) in text.lines().enumerate().skip(first) {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        match row(line, i + 1, separator, &wanted, &mut values)? {
            Row::Whole => {
                if let Some(empty) = ended {
                    let problem =
                        format!("has a sample in line {} after empty cells in line {empty}", i + 1);
                    return Err(Invalid::whole(
                        NAME,
                        problem,
                        "cut the log there, or fill the cells",
                    ));
                }
                if values[0].len() > most {
                    return Err(too_many(
                        NAME,
                        most,
                        "samples",
                        "cut it, or record at a lower rate",
                    ));
                }
            }
            Row::Ended => ended = ended.or(Some(i + 1)),
        }
    }
    let name_of = |i: usize| match &names {
        Some(names) => names[i].clone(),
        None => format!("column {}", i + 1),
    };
    let columns = places.iter().zip(values).map(|(place, values)| {
        let name = name_of(place.index);
        let unit = stated_unit(&name).and_then(unit_named);
        let position_unit = match unit {
            Some(Named::Position(unit)) => Some(unit),
            _ => None,
        };
        let time_unit = match unit {
            _ if place.role == Role::Time && are_moments[place.index] => Some(TimeUnit::S),
            Some(Named::Time(unit)) => Some(unit),
            _ => None,
        };
        Column { role: place.role, name, position_unit, time_unit, values }
    });
    Ok(columns.collect())
}

/// Largest number of samples that may be read: at most [`MOST_SAMPLES`], and no more than fit into the
/// memory of the process.
pub(super) fn most_samples() -> usize {
    MOST_SAMPLES.min((budget::memory_bytes() / BYTES_PER_SAMPLE as u64) as usize)
}

/// Result of reading a line.
enum Row {
    Whole,
    /// A cell of a wanted column is empty: the log ends.
    Ended,
}

/// A column that is read.
struct Wanted {
    /// Column, counted from 0.
    index: usize,
    /// True for moments of ISO 8601, false for numbers.
    is_moment: bool,
}

/// Appends the fields `wanted` (ascending) of a line, counted from 1.
fn row(
    line: &str,
    number: usize,
    separator: Separator,
    wanted: &[Wanted],
    values: &mut [Vec<f64>],
) -> Result<Row, Invalid> {
    let (mut next, mut empty, mut bad) = (0, false, None);
    separator.fields(line, |i, field| {
        if i != wanted[next].index {
            return true;
        }
        let value = match wanted[next].is_moment {
            true => moment::seconds(field),
            false => field.parse::<f64>().ok(),
        };
        match value {
            Some(v) if v.is_finite() => values[next].push(v),
            _ if field.is_empty() => {
                empty = true;
                return false;
            }
            _ => {
                bad = Some((i, field));
                return false;
            }
        }
        next += 1;
        next < wanted.len()
    });
    if let Some((i, field)) = bad {
        let is_moment = wanted.iter().any(|w| w.index == i && w.is_moment);
        let problem = format!(
            "has {} in line {number}, field {}, where a {} should be",
            short(field),
            i + 1,
            if is_moment { "time of ISO 8601" } else { "number" }
        );
        let remedy = "write finite numbers with a decimal point; cut the log where it is damaged";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    if next == wanted.len() {
        return Ok(Row::Whole);
    }
    // A separator at the end may be that of an empty cell.
    let closed = matches!(separator, Separator::Character(c) if line.trim_end().ends_with(c));
    if !(empty || closed) {
        let found = separator.count(line);
        let problem = format!(
            "has {found} fields in line {number}, {} are needed",
            wanted[wanted.len() - 1].index + 1
        );
        return Err(Invalid::whole(NAME, problem, "was it cut off? delete that line"));
    }
    for column in &mut values[..next] {
        column.pop();
    }
    Ok(Row::Ended)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::{PositionUnit, columns::Role};

    fn column(columns: &[Column], role: Role) -> &Column {
        columns.iter().find(|c| c.role == role).unwrap()
    }

    #[test]
    fn the_same_samples_from_every_controller() {
        let galil = "_RPA,_RPB,_TPA,_TPB,T\n1,2,10,20,0\n3,4,30,40,1\n,,,,2\n";
        let xps = "#setpoint actual\n1;10;2;20;\n3;30;4;40;\n";
        let named = "2\t0.0001\nG.X.SetpointPosition\tG.X.CurrentPosition\tG.Y.SetpointPosition\t\
                     G.Y.CurrentPosition\n1\t10\t2\t20\n3\t30\t4\t40\n";
        let aerotech = "Plot of 2026\n\nX Position Feedback (mm), Y Position Feedback (mm), \
                        \"X Position Command (mm)\", Y Position Command (mm)\n10,20,1,2\n30,40,3,4\n";
        for (format, text) in [
            (LogFormat::Galil, galil),
            (LogFormat::Xps, xps),
            (LogFormat::Xps, named),
            (LogFormat::Aerotech, aerotech),
        ] {
            let read = read(format, text.as_bytes(), &Columns::default()).unwrap();
            let of = |role| column(&read, role).values.clone();
            assert_eq!((of(Role::X), of(Role::Y)), (vec![10.0, 30.0], vec![20.0, 40.0]), "{text}");
            assert_eq!(of(Role::SetpointX), [1.0, 3.0], "{text}");
            assert_eq!(of(Role::SetpointY), [2.0, 4.0], "{text}");
        }
        let read = read(LogFormat::Aerotech, aerotech.as_bytes(), &Columns::default()).unwrap();
        assert_eq!(column(&read, Role::X).position_unit, Some(PositionUnit::Mm));
    }

    #[test]
    fn bad_rows_are_refused_with_their_line() {
        let said = |text: &str| {
            read(LogFormat::Csv, text.as_bytes(), &Columns::default()).unwrap_err().to_string()
        };
        let head = "x_mm,y_mm\n1,2\n".to_string();
        assert!(said(&format!("{head}3,nan\n")).contains("\"nan\" in line 3, field 2"));
        assert!(said(&format!("{head}3,\n4,5\n")).contains("line 4 after empty cells in line 3"));
        assert!(said(&format!("{head}3\n")).contains("has 1 fields in line 3, 2 are needed"));
        assert!(said("nothing\nhere\n").contains("no row of numbers"));
        assert!(said("1,2\n3,4\n").contains("2 columns without names"));
    }

    #[test]
    fn times_may_be_moments_and_then_are_seconds() {
        let text = "time,x_mm,y_mm\n2026-03-01T23:59:59.5Z,1,2\n2026-03-02T00:00:01Z,3,4\n";
        let read = |text: &str| read(LogFormat::Csv, text.as_bytes(), &Columns::default());
        let found = read(text).unwrap();
        let time = column(&found, Role::Time);
        assert_eq!((time.values[1] - time.values[0], time.time_unit), (1.5, Some(TimeUnit::S)));
        let said = read(&text.replace("2026-03-02T00:00:01Z", "7.5")).unwrap_err().to_string();
        assert!(said.contains("\"7.5\" in line 3, field 1, where a time of ISO 8601"), "{said}");
        let said = read(&text.replace("Z,3", "Z,2026-03-02T00:00:01Z")).unwrap_err().to_string();
        assert!(said.contains("line 3, field 2, where a number should be"), "{said}");
    }

    #[test]
    fn numbers_choose_columns_without_names() {
        let asked = Columns { x: Some("3".into()), y: Some("1".into()), ..Columns::default() };
        let read = read(LogFormat::Csv, b"1 2 3\n4 5 6\n\n7 8 9\n", &asked).unwrap();
        assert_eq!(column(&read, Role::X).values, [3.0, 6.0, 9.0]);
        assert_eq!(column(&read, Role::Y).values, [1.0, 4.0, 7.0]);
        assert_eq!(column(&read, Role::X).name, "column 3");
    }
}
