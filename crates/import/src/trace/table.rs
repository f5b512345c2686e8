//! Text in columns: one line per sample, fields separated by semicolon, tab, comma or white space.
//!
//! The samples are the longest run of lines that have numbers or times in the same columns. Lines above them may hold the
//! names of the columns and their units, in one line or in several as the TwinCAT Scope writes them:
//!
//! ```text
//! Name            ActPos_X   ActPos_Y
//! SampleTime[ms]  1          1
//! Unit            mm         mm
//!
//! 0               0.0        0.0
//! ```
//!
//! Empty cells may stand at the end, if one array of a Galil is shorter than another. The log ends with the first sample
//! that lacks a cell of a column that is read. Lines of text may follow the samples.
//!
//! A channel may have times of its own: the nearest column of times to its left.

use std::borrow::Cow;

use planish_types::{
    Invalid, budget,
    units::{Header, Quantity, Unit},
};

use super::{
    LogFormat, NAME,
    columns::{Column, ColumnPlace, Columns, Log, Role, is_time, places, short, stated_unit},
    moment::{self, Moment},
    stamp::Stamps,
};
use crate::{
    budget::{BYTES_PER_SAMPLE, MOST_SAMPLES, too_many},
    text,
};

/// Largest number of lines above the samples; a text with more is refused. Larger: more time on text that is no log.
/// Smaller: refuses logs with long headers.
const MOST_LINES_ABOVE: usize = 200;

/// Number of lines at the beginning of the file in which the samples are searched for: the largest number above the
/// samples, and as many samples plus one.
const LINES_LOOKED_AT: usize = 2 * MOST_LINES_ABOVE + 1;

/// Largest number of columns that are counted in a table. Larger: more time and memory for a hostile file.
/// Smaller: columns further to the right are not found.
const MOST_COLUMNS: usize = 1000;

/// Separator between the fields of a line: a character, or blanks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Separator {
    Character(char),
    Blank,
}

impl Separator {
    /// Returns the separator in a line: semicolon, tab or comma, in this priority, else blanks.
    fn in_line(line: &str) -> Self {
        let first = [';', '\t', ','].into_iter().find(|c| line.contains(*c));
        first.map_or(Self::Blank, Self::Character)
    }

    /// Calls `each` with the index and the trimmed text of every field, until `each` returns false. A separator at the
    /// end of the line adds no empty field.
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

    /// Returns the number of fields of a line, at most [`MOST_COLUMNS`].
    fn count(self, line: &str) -> usize {
        let mut count = 0;
        self.fields(line, |_, _| {
            count += 1;
            count < MOST_COLUMNS
        });
        count
    }

    /// Returns the fields of a line that names the columns, without the comment signs `#`, `%`, `!` or `/` before them.
    fn names(self, line: &str) -> Vec<String> {
        let line = line.trim().trim_start_matches(['#', '%', '!', '/']).trim();
        // A separator between quotes belongs to the name.
        if line.contains('"') && Self::in_line(line) == self {
            return text::fields(line).take(MOST_COLUMNS).map(String::from).collect();
        }
        let mut names = Vec::new();
        self.fields(line, |_, field| {
            names.push(field.trim_matches('"').to_string());
            names.len() < MOST_COLUMNS
        });
        names
    }
}

/// Kind of content of a field (cell) of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Class {
    Number,
    Moment,
    Empty,
    Text,
}

impl Class {
    /// Returns the kind of content of a field (cell) of the table.
    fn new(field: &str) -> Self {
        if field.is_empty() {
            Self::Empty
        } else if field.parse::<f64>().is_ok() {
            Self::Number
        } else if Moment::read(field).is_some() {
            Self::Moment
        } else {
            Self::Text
        }
    }

    fn is_value(self) -> bool {
        matches!(self, Self::Number | Self::Moment)
    }
}

/// Returns the kinds of the fields of a line that may be a sample: at least two are numbers or moments. Returns `None`
/// for other lines.
fn classes(line: &str) -> Option<Vec<Class>> {
    let mut classes = Vec::new();
    Separator::in_line(line).fields(line, |_, field| {
        classes.push(Class::new(field));
        classes.len() < MOST_COLUMNS
    });
    if classes.iter().filter(|class| class.is_value()).count() < 2 { None } else { Some(classes) }
}

/// Returns true if a line whose fields are of the kinds `next` may follow one of the kinds `first`. It has no more
/// fields, and each pair is of the same kind or has an empty one.
fn follows(first: &[Class], next: &[Class]) -> bool {
    next.len() <= first.len()
        && first.iter().zip(next).all(|(a, b)| a == b || [a, b].contains(&&Class::Empty))
}

/// Returns true if the line is empty or a comment, so that it neither is a sample nor interrupts the samples.
fn is_skipped(line: &str) -> bool {
    line.trim().is_empty() || line.starts_with('#')
}

/// Returns the index of the line with the first sample, and the kinds of its fields, for an empty one that of a usual
/// sample. Returns `None` if no line may be a sample.
fn first_sample(lines: &[Cow<'_, str>]) -> Option<(usize, Vec<Class>)> {
    let rows: Vec<Option<Vec<Class>>> = lines.iter().map(|line| classes(line)).collect();
    // The longest run of samples, and the last of equal ones.
    let mut longest: Option<(usize, usize)> = None;
    let mut run: Option<(usize, usize)> = None;
    for (i, row) in rows.iter().enumerate() {
        run = match (row, run) {
            (Some(row), Some((start, count)))
                if rows[start].as_ref().is_some_and(|first| follows(first, row)) =>
            {
                Some((start, count + 1))
            }
            (Some(_), _) => Some((i, 1)),
            (None, run) if is_skipped(&lines[i]) => run,
            (None, _) => None,
        };
        if let Some((_, count)) = run
            && longest.is_none_or(|(_, most)| count >= most)
        {
            longest = run;
        }
    }
    let (start, _) = longest?;
    let pattern = rows[start].as_ref()?;
    // Samples above a damaged line are samples; one line of numbers above the names is none.
    let above: Vec<usize> = (0..start)
        .filter(|i| rows[*i].as_ref().is_some_and(|row| is_sample(row, pattern)))
        .collect();
    let first = match above[..] {
        [] => start,
        [only] if (only..start).any(|i| rows[i].is_none() && is_text(&lines[i])) => start,
        [first, ..] => first,
    };
    let mut classes = rows[first].clone()?;
    for (class, usual) in classes.iter_mut().zip(pattern) {
        if *class == Class::Empty {
            *class = *usual;
        }
    }
    Some((first, classes))
}

/// Returns true if a line of the kinds `row` may be a sample of a log whose usual samples have the kinds `pattern`. It
/// has as many fields, and each is of the same kind, empty, or a number for a moment or the other way round.
fn is_sample(row: &[Class], pattern: &[Class]) -> bool {
    row.len() == pattern.len()
        && row
            .iter()
            .zip(pattern)
            .all(|(a, b)| a == b || *a == Class::Empty || (a.is_value() && b.is_value()))
}

/// Returns true if the line has no digits, and is neither empty nor a comment.
fn is_text(line: &str) -> bool {
    !is_skipped(line) && !line.chars().any(|c| c.is_ascii_digit())
}

/// Layout of a table: where the samples begin, and the names and units of its columns.
struct TableLayout {
    /// Index of the line with the first sample, from 0.
    first: usize,
    separator: Separator,
    /// Kinds of the fields of a sample, one per column.
    classes: Vec<Class>,
    names: Option<Vec<String>>,
    /// Units that a line of units states, one word per column.
    units: Option<Vec<String>>,
    /// Units of the times in a line such as `SampleTime[ms]`, one per column.
    time_units: Vec<Option<Unit>>,
    warnings: Vec<String>,
}

/// Words that begin a line of units.
const UNIT_LINES: [&str; 6] = ["unit", "units", "einheit", "einheiten", "unité", "unités"];

/// Returns true if `cells` are the units of the columns. At least one is a known unit, after `Unit` in the first cell;
/// without it, all words are known units, and there are two or more.
fn are_units(cells: &[String]) -> bool {
    let words = cells.iter().filter(|cell| !cell.is_empty() && !begins_units(cell));
    let units = words.clone().filter(|cell| Unit::read(cell, &[]).is_some()).count();
    let is_marked = cells.first().is_some_and(|cell| begins_units(cell));
    units > 0 && (is_marked || (units == words.count() && units > 1))
}

/// Returns true if the cell is a word that begins a line of units.
fn begins_units(cell: &str) -> bool {
    UNIT_LINES.contains(&cell.trim_end_matches(':').to_lowercase().as_str())
}

/// Words in a line above the samples that may state a number that belongs to the samples, such as a scale.
const STATEMENTS: [&str; 9] =
    ["unit", "einheit", "scale", "factor", "faktor", "offset", "rate", "frequency", "interval"];

impl TableLayout {
    /// Finds the samples, and reads the lines above them. Refuses a text whose first `MOST_LINES_ABOVE` lines and the
    /// next are no samples.
    fn read(lines: &[Cow<'_, str>]) -> Result<Self, Invalid> {
        let looked_at = lines.len().min(MOST_LINES_ABOVE);
        let sample = first_sample(lines).filter(|(first, _)| *first <= MOST_LINES_ABOVE);
        let Some((first, classes)) = sample else {
            let line = lines.iter().find(|line| !line.trim().is_empty());
            let problem = format!(
                "has no row of numbers in its first {looked_at} lines, the first of which is {}",
                short(line.map_or("", |line| line))
            );
            let remedy = "give text with a line per sample: two numbers or more, separated by commas, semicolons, tabs or \
                          blanks; or another `format`";
            return Err(Invalid::whole(NAME, problem, remedy));
        };
        let separator = Separator::in_line(&lines[first]);
        let count = separator.count(&lines[first]);
        let mut layout = Self {
            first,
            separator,
            classes,
            names: None,
            units: None,
            time_units: vec![None; count],
            warnings: Vec::new(),
        };
        let mut best = None;
        let mut used = Vec::new();
        for i in (0..first).filter(|i| !lines[*i].trim().is_empty()) {
            let cells = separator.names(&lines[i]);
            if cells.len() != count {
                continue;
            }
            if are_units(&cells) {
                layout.units = Some(cells);
                used.push(i);
                continue;
            }
            let mut states_time = false;
            for (unit, cell) in layout.time_units.iter_mut().zip(&cells) {
                let header = Header::read(cell, &[Quantity::Time]);
                let stated = header.ok().filter(|h| is_time(&h.name)).and_then(|h| h.unit);
                if let Some(stated) = stated.filter(|unit| unit.quantity() == Quantity::Time) {
                    *unit = Some(stated);
                    states_time = true;
                }
            }
            let numbers = cells.iter().filter(|cell| Class::new(cell).is_value()).count();
            if states_time && numbers > 0 {
                used.push(i);
                continue;
            }
            // Names are the line with the fewest numbers; of equal ones that with most known names, then the last.
            let known = cells.iter().filter(|cell| is_known(cell)).count();
            let rank = (usize::MAX - numbers, known, i);
            if has_word(&cells) && best.as_ref().is_none_or(|(other, _)| rank > *other) {
                best = Some((rank, cells));
            }
        }
        if let Some(((.., i), names)) = best {
            layout.names = Some(names);
            used.push(i);
        }
        let quoted: Vec<String> = (0..first)
            .filter(|i| !used.contains(i) && states_a_number(&lines[*i]))
            .take(3)
            .map(|i| format!("{} (line {})", short(&lines[i]), i + 1))
            .collect();
        if !quoted.is_empty() {
            let quoted = quoted.join(", ");
            layout.warnings.push(format!("lines above the samples that are not used: {quoted}"));
        }
        Ok(layout)
    }

    /// Returns the name of the column with this index (from 0), or its number (from 1) as text.
    fn name_of(&self, index: usize) -> String {
        match &self.names {
            Some(names) => names[index].clone(),
            None => format!("column {}", index + 1),
        }
    }

    /// Returns the unit that the lines above the samples state for the column `index`; `None` without one. Refuses a
    /// line of units that contradicts the name of the column, and what `stated_unit` refuses.
    fn unit_of(
        &self,
        role: Role,
        index: usize,
        requested: &Columns,
    ) -> Result<Option<Unit>, Invalid> {
        let of_name = match &self.names {
            Some(names) => stated_unit(role, requested, &names[index], false)?,
            None => None,
        };
        let word = self.units.as_ref().map(|units| units[index].as_str());
        let word = word.filter(|w| !w.trim_end_matches(':').is_empty() && !begins_units(w));
        let of_word = match word {
            Some(word) => stated_unit(role, requested, word, true)?,
            None if role.is_time() => self.time_units[index],
            None => None,
        };
        if let (Some(a), Some(b)) = (of_name, of_word)
            && a != b
        {
            let problem = format!("is in {a} by its name, and in {b} by the line of units");
            return Err(Invalid::whole(role.setting(), problem, "correct one of the two"));
        }
        Ok(of_name.or(of_word))
    }
}

/// Returns true if a line above the samples states a number other than 0 and 1, such as a scale, that could change the
/// samples.
fn states_a_number(line: &str) -> bool {
    let line = line.to_lowercase();
    let mut words = line.split([' ', '\t', ';', ',', '=', ':']);
    STATEMENTS.iter().any(|word| line.contains(word))
        && words.any(|word| word.parse::<f64>().is_ok_and(|v| v != 0.0 && v != 1.0))
}

/// Returns true if a line of these cells may name columns, because at least one cell is a word.
fn has_word(cells: &[String]) -> bool {
    cells.iter().any(|cell| Class::new(cell) == Class::Text)
}

/// Returns true if the name is that of a time, or of a position along x or y.
fn is_known(name: &str) -> bool {
    let lower = name.to_lowercase();
    is_time(name)
        || lower.split(|c: char| !c.is_alphanumeric()).any(|word| word == "x" || word == "y")
}

/// Returns the first lines of a text, and true if the text has decimal commas, which become points in these lines.
fn head_of(text: &str) -> (Vec<Cow<'_, str>>, bool) {
    let lines = text.lines().take(LINES_LOOKED_AT);
    let has_commas = lines.clone().any(|line| {
        with_points(line).is_some_and(|converted| values_in(&converted) > values_in(line))
    });
    let head = lines.map(|line| match with_points(line).filter(|_| has_commas) {
        Some(converted) => Cow::Owned(converted),
        None => Cow::Borrowed(line),
    });
    (head.collect(), has_commas)
}

/// Returns a line with points for its decimal commas; `None` if it has none. Lines in which commas separate thousands
/// are converted too; they are refused when all lines are read.
fn with_points(line: &str) -> Option<String> {
    text::with_points(NAME, line).unwrap_or_else(|_| Some(line.replace(',', ".")))
}

/// Returns the number of numbers and moments in a line that may be a sample; 0 for another line.
fn values_in(line: &str) -> usize {
    classes(line).map_or(0, |row| row.iter().filter(|class| class.is_value()).count())
}

/// Reads the columns of a log that the user requests, or whose names are known. `format` decides which names are known.
///
/// # Errors
/// Refuses a text without samples or without the positions, damaged lines among the samples, and units that contradict
/// each other.
pub fn read(format: LogFormat, bytes: &[u8], requested: &Columns) -> Result<Log, Invalid> {
    let text = text::text(NAME, bytes)?;
    let (head, has_commas) = head_of(&text);
    let mut layout = TableLayout::read(&head)?;
    let mut warnings = std::mem::take(&mut layout.warnings);
    let start: usize = text.split_inclusive('\n').take(layout.first).map(str::len).sum();
    let mut body = Cow::Borrowed(&text[start..]);
    if has_commas && let Some(converted) = text::with_points(NAME, &body)? {
        body = Cow::Owned(converted);
        warnings.push(text::DECIMAL_COMMAS.into());
    }
    let count = layout.classes.len().max(layout.time_units.len());
    let places = places(format, layout.names.as_deref(), count, requested)?;
    if let Some(names) = &layout.names
        && requested.axes.is_empty()
    {
        let further = super::columns::further_axes(format, names);
        if !further.is_empty() {
            warnings.push(format!(
                "the log has positions of {} too, which are not read: give `machine` for the motion of all axes",
                further.join(", ")
            ));
        }
    }
    let channels = Channels::new(&places, &layout);
    let mut wanted: Vec<Wanted> = Vec::new();
    let all = places.iter().map(|place| (place.index, place.role.is_time()));
    let all = all.chain(channels.columns().into_iter().map(|index| (index, true)));
    for (index, is_time) in all {
        if !wanted.iter().any(|w| w.index == index) {
            let class = layout.classes.get(index).copied().unwrap_or(Class::Empty);
            wanted.push(Wanted { index, values: ColumnValues::new(class, is_time) });
        }
    }
    wanted.sort_by_key(|w| w.index);
    if let Some(footer) = rows(&body, &layout, &mut wanted)? {
        warnings.push(footer);
    }
    let column = |role: Role, index: usize| -> Result<Column, Invalid> {
        let read = wanted.iter().find(|w| w.index == index).expect("all columns are wanted");
        let unit = layout.unit_of(role, index, requested)?;
        read.values.column(role, layout.name_of(index), unit)
    };
    let mut columns = Vec::with_capacity(places.len());
    for place in places.iter().filter(|place| place.role != Role::TimeY) {
        columns.push(column(place.role, place.index)?);
    }
    let mut times = Vec::new();
    for index in channels.columns() {
        times.push(column(Role::Time, index)?);
    }
    let mut log = Log { columns, times, warnings };
    channels.assign(&mut log, &places, requested)?;
    Ok(log)
}

/// Returns the largest number of samples that may be read: at most [`MOST_SAMPLES`], and no more than fit into the
/// memory of the process. Each takes [`BYTES_PER_SAMPLE`].
pub(super) fn most_samples() -> usize {
    MOST_SAMPLES.min((budget::memory_bytes() / BYTES_PER_SAMPLE as u64) as usize)
}

/// Columns of separate time stamps, which belong to single quantities instead of to the whole log.
struct Channels {
    /// Index of the column of time stamps of each quantity, in the order of the `places`; `None` for the time stamps of
    /// the log.
    own: Vec<Option<usize>>,
    /// Columns of numbers directly to the left of a position in a table without names, with the quantity of this
    /// position. They may be its time stamps.
    suspects: Vec<(Role, usize)>,
}

impl Channels {
    /// Finds the columns of separate time stamps: the stated `time_y`, else by their names, else (as suspects) by their
    /// position in the table. A log without a column of time stamps has none.
    fn new(places: &[ColumnPlace], layout: &TableLayout) -> Self {
        let mut channels = Self { own: vec![None; places.len()], suspects: Vec::new() };
        let Some(main) = places.iter().find(|p| p.role == Role::Time) else { return channels };
        let main = main.index;
        if let Some(time_y) = places.iter().find(|p| p.role == Role::TimeY) {
            for (own, place) in channels.own.iter_mut().zip(places) {
                if matches!(place.role, Role::Y | Role::SetpointY) && time_y.index != main {
                    *own = Some(time_y.index);
                }
            }
            return channels;
        }
        let is_free = |index: usize| index != main && places.iter().all(|p| p.index != index);
        let Some(names) = &layout.names else {
            for place in places.iter().filter(|place| place.role.is_position()) {
                let Some(left) = place.index.checked_sub(1) else { continue };
                if is_free(left) && layout.classes.get(left) == Some(&Class::Number) {
                    channels.suspects.push((place.role, left));
                }
            }
            return channels;
        };
        let times: Vec<usize> = (0..names.len())
            .filter(|i| {
                *i == main || (is_free(*i) && (is_time(&names[*i]) || names[*i] == names[main]))
            })
            .collect();
        let nearest: Vec<Option<usize>> = places
            .iter()
            .map(|place| times.iter().copied().rfind(|time| *time < place.index))
            .collect();
        let of_positions =
            places.iter().zip(&nearest).filter(|(place, _)| place.role.is_position());
        let mut of_positions = of_positions.map(|(_, time)| time);
        // Where all positions have the same times, those are times of the log, and the stated ones count.
        let first = of_positions.next();
        if of_positions.any(|time| Some(time) != first) {
            for ((own, place), time) in channels.own.iter_mut().zip(places).zip(nearest) {
                *own = time.filter(|t| *t != main && !place.role.is_time());
            }
        }
        channels
    }

    /// Returns the indices of the columns to read besides those of the quantities, ascending.
    fn columns(&self) -> Vec<usize> {
        let suspects = self.suspects.iter().map(|suspect| suspect.1);
        let mut columns: Vec<usize> = self.own.iter().flatten().copied().chain(suspects).collect();
        columns.sort_unstable();
        columns.dedup();
        columns
    }

    /// Assigns separate time stamps to the quantities. Refuses a column without a name whose numbers are the time
    /// stamps of the log plus a constant other than 0.
    fn assign(
        &self,
        log: &mut Log,
        places: &[ColumnPlace],
        requested: &Columns,
    ) -> Result<(), Invalid> {
        let columns = self.columns();
        for (place, own) in places.iter().zip(&self.own) {
            let own = own.and_then(|own| columns.iter().position(|column| *column == own));
            if let Some(column) = log.columns.iter_mut().find(|c| c.role == place.role) {
                column.own_time = own;
            }
        }
        if self.suspects.is_empty() {
            return Ok(());
        }
        let main = log.columns.iter().find(|c| c.role == Role::Time);
        let main = main.expect("a log without times has no channels");
        for (role, index) in &self.suspects {
            let place = columns.iter().position(|column| column == index).expect("it was read");
            let other = &log.times[place];
            let later = other.first - main.first;
            let step = main.values.get(1).copied().unwrap_or(0.0);
            let mut pairs = main.values.iter().zip(&other.values);
            if later != 0.0 && pairs.all(|(a, b)| (a - b).abs() <= 1e-6 * step.abs()) {
                let problem = format!(
                    "{} goes like the times in {}, {later} later: it may be the time of {}",
                    other.name,
                    main.name,
                    requested.name(*role)
                );
                let remedy = format!(
                    "give `time_y` {} where it is, and `time_y` with the column of `time` where it is not",
                    index + 1
                );
                return Err(Invalid::whole(NAME, problem, remedy));
            }
        }
        log.times.clear();
        Ok(())
    }
}

/// Values of a column while it is read: numbers, numeric time stamps, or moments.
enum ColumnValues {
    Numbers(Vec<f64>),
    Stamps(Stamps),
    Moments(Vec<Moment>),
}

impl ColumnValues {
    /// Creates an empty list of values, for a column whose field in the first sample is of the kind `class`.
    fn new(class: Class, is_time: bool) -> Self {
        if !is_time {
            Self::Numbers(Vec::new())
        } else if class == Class::Moment {
            Self::Moments(Vec::new())
        } else {
            Self::Stamps(Stamps::default())
        }
    }

    /// Appends the value of a field; returns false, and appends nothing, if the field has no value of this kind.
    fn push(&mut self, field: &str) -> bool {
        match self {
            Self::Numbers(values) => match field.parse::<f64>() {
                Ok(v) if v.is_finite() => values.push(v),
                _ => return false,
            },
            Self::Stamps(stamps) => return stamps.push(field),
            Self::Moments(moments) => match Moment::read(field) {
                Some(moment) => moments.push(moment),
                None => return false,
            },
        }
        true
    }

    /// Removes the last value, of a line that turned out to be no sample.
    fn pop(&mut self) {
        match self {
            Self::Numbers(values) => drop(values.pop()),
            Self::Stamps(stamps) => stamps.pop(),
            Self::Moments(moments) => drop(moments.pop()),
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Numbers(values) => values.len(),
            Self::Stamps(stamps) => stamps.differences.len(),
            Self::Moments(moments) => moments.len(),
        }
    }

    /// Returns the column with these values; moments become seconds after the first one. Refuses moments that
    /// `moment::times` refuses.
    fn column(&self, role: Role, name: String, unit: Option<Unit>) -> Result<Column, Invalid> {
        let column = match self {
            Self::Numbers(values) => Column::of_values(role, name, unit, values.clone()),
            Self::Stamps(stamps) => Column {
                first: stamps.first,
                resolution: stamps.resolution(),
                ..Column::of_values(role, name, unit, stamps.differences.clone())
            },
            Self::Moments(moments) => {
                let times = moment::times(moments).map_err(|i| {
                    let problem = "is a moment without the date that the others have, or with one that is none in their order";
                    Invalid::at_index(role.setting(), i, problem, "write all dates as 2026-03-01")
                })?;
                let seconds = Unit::read("s", &[]);
                let mut column = Column::of_values(role, name, seconds, times.seconds);
                column.resolution = times.resolution_s;
                column.first_moment = moments.first().copied();
                column
            }
        };
        Ok(column)
    }
}

/// A column of the table to read, with the values that were read so far.
struct Wanted {
    /// Index of the column, counted from 0.
    index: usize,
    values: ColumnValues,
}

/// Appends all samples of the text `body` to the columns `wanted`, which are in ascending order of their indices.
/// Returns a warning if lines of text follow the samples. Refuses a damaged line, a sample after one with empty cells,
/// and too many samples.
fn rows(
    body: &str,
    layout: &TableLayout,
    wanted: &mut [Wanted],
) -> Result<Option<String>, Invalid> {
    let most = most_samples();
    let mut ended = None;
    let mut lines = body.lines().enumerate();
    while let Some((i, line)) = lines.next() {
        if is_skipped(line) {
            continue;
        }
        let number = layout.first + i + 1;
        match row(line, number, layout.separator, wanted) {
            Ok(SampleEnd::Whole) => {
                if let Some(empty) = ended {
                    let problem =
                        format!("has a sample in line {number} after empty cells in line {empty}");
                    let remedy = "cut the log there, or fill the cells";
                    return Err(Invalid::whole(NAME, problem, remedy));
                }
                if wanted[0].values.len() > most {
                    let remedy = "cut it, or record at a lower rate";
                    return Err(too_many(NAME, most, "samples", remedy));
                }
            }
            Ok(SampleEnd::Empty) => ended = ended.or(Some(number)),
            Err(error) => {
                let mut begins_with_text = false;
                layout.separator.fields(line, |_, field| {
                    begins_with_text = Class::new(field) == Class::Text;
                    false
                });
                // Text to the end of the file is no sample; a damaged line has samples after it, or begins with a number.
                let mut rest = std::iter::once(line).chain(lines.map(|(_, line)| line));
                if !begins_with_text || rest.any(|line| classes(line).is_some()) {
                    return Err(error);
                }
                return Ok(Some(format!(
                    "the samples end before line {number}, {}: it and what follows are not used",
                    short(line)
                )));
            }
        }
    }
    Ok(None)
}

/// State of a sample (line of the table) after it was read.
enum SampleEnd {
    /// All wanted cells of the line have values.
    Whole,
    /// A cell of a wanted column is empty, so that the log ends before this line.
    Empty,
}

/// Appends the fields of line `number`, counted from 1, to the columns `wanted`, which are in ascending order of their
/// indices. A line that lacks a value appends nothing. Refuses a field that is no value of its column, and a line that
/// is cut off.
fn row(
    line: &str,
    number: usize,
    separator: Separator,
    wanted: &mut [Wanted],
) -> Result<SampleEnd, Invalid> {
    let mut next = 0;
    let mut empty = false;
    let mut bad = None;
    separator.fields(line, |i, field| {
        if i != wanted[next].index {
            return true;
        }
        if !wanted[next].values.push(field) {
            empty = field.is_empty();
            bad = if empty { None } else { Some((next, field)) };
            return false;
        }
        next += 1;
        next < wanted.len()
    });
    if next == wanted.len() {
        return Ok(SampleEnd::Whole);
    }
    for column in &mut wanted[..next] {
        column.values.pop();
    }
    if let Some((which, field)) = bad {
        let should = match wanted[which].values {
            ColumnValues::Moments(_) => "time such as 2026-03-01T12:00:00.5 or 12:00:00.5",
            _ => "number",
        };
        let column = wanted[which].index + 1;
        let problem = format!(
            "has {} in line {number}, field {column}, where a {should} should be",
            short(field)
        );
        let remedy = "write finite numbers with a decimal point; cut the log where it is damaged";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    // A separator at the end may be that of an empty cell.
    let closed = matches!(separator, Separator::Character(c) if line.trim_end().ends_with(c));
    if !(empty || closed) {
        let count = separator.count(line);
        let problem = format!(
            "has {count} fields in line {number}, {} are needed",
            wanted[wanted.len() - 1].index + 1
        );
        return Err(Invalid::whole(NAME, problem, "was it cut off? delete that line"));
    }
    Ok(SampleEnd::Empty)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::columns::Role;

    fn column(log: &Log, role: Role) -> &Column {
        log.columns.iter().find(|c| c.role == role).unwrap()
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
        assert_eq!(column(&read, Role::X).unit, Unit::read("mm", &[]));
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
        assert_eq!((time.values[1] - time.values[0], time.unit), (1.5, Unit::read("s", &[])));
        let said = read(&text.replace("2026-03-02T00:00:01Z", "7.5")).unwrap_err().to_string();
        assert!(said.contains("\"7.5\" in line 3, field 1, where a time such as"), "{said}");
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

    /// Checks the header of a TwinCAT Scope, whose last line above the samples does not hold the names of the columns.
    #[test]
    fn names_and_units_may_have_lines_of_their_own() {
        let head = "Name\tScope\nStart\t132959733843760000\tMontag\n\nName\tActPos_X\tActPos_Y\n\
                    SampleTime[ms]\t1\t1\nUnit\tum\tmm\nUnit Offset\t0\t0\n\n";
        let text = format!("{head}0\t0.5\t2\n1\t1.5\t3\nEOF\nTotal 7 s\n");
        let asked = Columns { time: Some("Name".into()), ..Columns::default() };
        let log = read(LogFormat::Csv, text.as_bytes(), &asked).unwrap();
        let unit = |role| column(&log, role).unit.unwrap().to_string();
        assert_eq!([Role::Time, Role::X, Role::Y].map(unit), ["ms", "um", "mm"]);
        assert_eq!(column(&log, Role::X).values, [0.5, 1.5]);
        assert_eq!(log.warnings.len(), 1);
        assert!(log.warnings[0].contains("end before line 11, \"EOF\""), "{:?}", log.warnings);
        let scaled = text.replace("Unit Offset\t0\t0", "Scale factor\t2\t1");
        let log = read(LogFormat::Csv, scaled.as_bytes(), &asked).unwrap();
        assert!(log.warnings[0].contains("not used: \"Scale factor"), "{:?}", log.warnings);
        let said =
            |text: &str| read(LogFormat::Csv, text.as_bytes(), &asked).unwrap_err().to_string();
        let unknown = said(&text.replace("\tum\t", "\tfurlong\t"));
        assert!(unknown.contains("x: is \"furlong\", which is no known unit"), "{unknown}");
        // A damaged line has samples after it.
        let damaged = said(&text.replace("EOF", "abc\tdef\tghi\n2\t2.5\t4"));
        assert!(damaged.contains("\"abc\" in line 11, field 1"), "{damaged}");
        // A short log with a long footer.
        let log = read(
            LogFormat::Csv,
            b"x_mm,y_mm\n1,2\n3,4\n5,6\nend,of,file\nby,,me\n",
            &Columns::default(),
        );
        assert_eq!(column(&log.unwrap(), Role::X).values, [1.0, 3.0, 5.0]);
    }

    #[test]
    fn decimal_commas_quotes_and_encodings_of_logs() {
        let x = |bytes: &[u8]| {
            let log = read(LogFormat::Csv, bytes, &Columns::default()).unwrap();
            (column(&log, Role::Time).values.clone(), column(&log, Role::X).values.clone())
        };
        let right = (vec![0.0, 0.5], vec![0.25, 1.75]);
        let comma = "t (s);x (mm);y (mm)\n0,0;0,25;1\n0,5;1,75;2\n";
        assert_eq!(x(comma.as_bytes()), right);
        assert_eq!(x(comma.replace(';', "\t").as_bytes()), right);
        assert_eq!(
            x(b"\"t (s)\",\"x, mm\",\"y\"\n\"0.0\",\"0.25\",\"1\"\n\"0.5\",\"1.75\",\"2\"\n"),
            right
        );
        let moments =
            "Zeit;x_mm;y_mm\n01.03.2026 23:59:59,5;0,25;1\n02.03.2026 00:00:00,0;1,75;2\n";
        assert_eq!(x(moments.as_bytes()), right);
        let utf16: Vec<u8> =
            [0xFEFF].into_iter().chain(comma.encode_utf16()).flat_map(u16::to_le_bytes).collect();
        assert_eq!(x(&utf16), right);
        let text =
            read(LogFormat::Csv, b"x_mm;y_mm\n1,500;2,250\n2,500;3,250\n", &Columns::default());
        assert!(text.unwrap_err().to_string().contains("marks of thousands"));
        // A status is no number, and not read.
        let log = read(LogFormat::Csv, b"x_mm,y_mm,state\n1,2,RUN\n3,4,RUN\n", &Columns::default());
        assert_eq!(column(&log.unwrap(), Role::Y).values, [2.0, 4.0]);
    }

    #[test]
    fn channels_have_times_of_their_own() {
        let named = "Name\tActPos_X\tName\tActPos_Y\nSampleTime[ms]\t1\tSampleTime[ms]\t1\n\
                     Unit\tmm\tUnit\tmm\n0\t0\t3\t7\n1\t1\t4\t8\n";
        let asked = Columns { time: Some("1".into()), ..Columns::default() };
        let log = read(LogFormat::Csv, named.as_bytes(), &asked).unwrap();
        let y = column(&log, Role::Y);
        assert_eq!((y.own_time, column(&log, Role::X).own_time), (Some(0), None));
        assert_eq!(
            (log.times[0].first, log.times[0].unit.unwrap().to_string()),
            (3.0, "ms".into())
        );
        // Two clocks of the same channels: the given one counts.
        let clocks = "PC time,time,x_mm,y_mm\n0,5,1,2\n1,6,3,4\n";
        let asked = Columns { time: Some("PC time".into()), ..Columns::default() };
        let log = read(LogFormat::Csv, clocks.as_bytes(), &asked).unwrap();
        assert!(log.times.is_empty() && column(&log, Role::Y).own_time.is_none());
        // Without names the program asks.
        let text = "0 0 3 7\n1 1 4 8\n2 2 5 9\n";
        let asked = |time_y: Option<&str>| {
            let [time, x, y] = ["1", "2", "4"].map(|number| Some(number.to_string()));
            let time_y = time_y.map(String::from);
            let asked = Columns { time, x, y, time_y, ..Columns::default() };
            read(LogFormat::Csv, text.as_bytes(), &asked)
        };
        let said = asked(None).unwrap_err().to_string();
        assert!(said.contains("column 3 goes like the times in column 1, 3 later"), "{said}");
        assert_eq!(asked(Some("3")).unwrap().times.len(), 1);
        assert!(asked(Some("1")).unwrap().times.is_empty());
    }
}
