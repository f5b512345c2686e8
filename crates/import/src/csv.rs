//! A matrix of numbers as text: one line per row, fields separated by comma, semicolon, tab or
//! white space, with a decimal point, or with a decimal comma where that is certain. Lines that start with `#` or `%`
//! are comments; an empty field, `nan`, `bad`, `#N/A` or another word for no data is an invalid pixel. A
//! separator at the end of a line closes it if all lines end so and no field is empty; otherwise an empty field follows
//! it.
//!
//! What a file says of itself is obeyed:
//!
//! * Comments `# Width: 15.0 mm`, `# Height: 10.0 mm` and `# Value units: m` as Gwyddion's export of text writes them, or
//!   `# unit: nm`: the pitch is width over columns, and the first row of an export of Gwyddion is the top.
//! * Comments `# x-length = 1000`, `# x-unit = nm`, `# z-unit = nm`, `# Bit2nm = 0.5` as in ASCII files of SPIP.
//! * Comments `# pixel size: 0.5 mm`, `# pitch (um) = 500`: the pitch along x and y.
//! * A first line and a first column of coordinates: they ascend or descend in equal steps, and the corner is empty or a
//!   word. The coordinates have no unit.
//!
//! A comment that speaks of a unit or a pitch and is not understood is a warning. Text that is no matrix of heights is
//! refused: coordinates or row numbers beside heights, lines `x y z`, profiles, and several matrices one after the other.
//!
//! Source: the manuals of Gwyddion ("Export", text matrix) and SPIP ("ASCII file format").

use ndarray::{Array2, s};
use planish_types::Invalid;

use crate::{
    Format, Unit,
    budget::{BYTES_PER_PIXEL, check_room, check_size, most_of},
    reading::{Coordinates, FirstRow, Reading},
    text,
};

const NAME: &str = "CSV file";

/// Largest departure of a step of axes from their mean step, as a fraction: axes are written with few digits.
const UNIFORMITY: f64 = 0.01;

/// Fewest numbers of a line that make it an axis: three may lie in equal steps by chance.
const FEWEST: usize = 4;

/// Fewest numbers in equal steps that are certainly no heights, where the next line has none. Larger: coordinates of small
/// maps are read as heights. Smaller: heights in whole numbers are refused by chance.
const CERTAIN: usize = 8;

/// Most comments that a warning quotes.
const MOST_QUOTED: usize = 5;

/// Reads a matrix.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let with_points = text::with_points(NAME, &text)?;
    let Table { values, mut header, corner_is_empty } =
        table(with_points.as_deref().unwrap_or(&text))?;
    let (rows, columns) = values.dim();
    let x = values.slice(s![0, 1..]).to_vec();
    let y = values.slice(s![1.., 0]).to_vec();
    let are_axes = is_uniform(&x) && is_uniform(&y);
    let has_axes = corner_is_empty && are_axes;
    if let Some(error) = header.corner.take().filter(|_| !has_axes) {
        return Err(error);
    }
    let mut reading = if has_axes {
        check_size(NAME, rows - 1, columns - 1)?;
        let heights = values.slice(s![1.., 1..]).to_owned();
        let mut reading = Reading::new(Format::Csv, heights, FirstRow::SmallestY);
        let say =
            "the first line and the first column are the coordinates x and y: the corner is empty";
        reading.warnings.push(say.into());
        reading.coordinates = Some(Coordinates { x, y, unit: None });
        reading
    } else {
        refuse_other_tables(&values)?;
        Reading::new(Format::Csv, values, FirstRow::SmallestY)
    };
    if are_axes && !has_axes {
        reading.warnings.push(
            "the first line and the first column go in equal steps, as coordinates do, and are read as heights; if they are \
             coordinates, empty the first field"
                .into(),
        );
    }
    if with_points.is_some() {
        reading.warnings.push(text::DECIMAL_COMMAS.into());
    }
    header.apply(&mut reading)?;
    Ok(reading)
}

/// The numbers of a text, and what it says beside them.
struct Table {
    values: Array2<f64>,
    header: Header,
    corner_is_empty: bool,
}

fn table(text: &str) -> Result<Table, Invalid> {
    let mut values = Vec::new();
    let (mut rows, mut columns) = (0, 0);
    let most = most_of(BYTES_PER_PIXEL);
    let mut header = Header::default();
    let mut corner_is_empty = false;
    // True while all lines end with a separator, and while no field before it is empty.
    let mut are_closed = true;
    let mut are_full = true;
    let mut gaps = Gaps::default();
    for (i, line) in text.lines().enumerate() {
        // A tab may be a separator: a line of tabs is a row of invalid pixels.
        let is_blank = line.trim_matches([' ', '\r']).is_empty();
        if is_blank || text::is_comment(line) {
            gaps.open(rows);
            if !is_blank {
                header.add(line.trim_start().trim_start_matches(['#', '%']), i + 1)?;
            }
            continue;
        }
        gaps.close(rows, i + 1);
        let before = values.len();
        let is_closed = text::is_closed(line);
        are_closed &= is_closed;
        let (mut empty, mut ends_empty) = (0usize, false);
        for (k, field) in text::fields(line).chain(is_closed.then_some("")).enumerate() {
            if values.len() >= most {
                check_room(NAME, values.len(), BYTES_PER_PIXEL)?;
            }
            let is_corner = rows == 0 && k == 0;
            let is_word = field.parse::<f64>().is_err();
            corner_is_empty |= is_corner && is_word;
            ends_empty = field.is_empty();
            empty += usize::from(ends_empty && !is_corner);
            values.push(match text::number(NAME, field, i + 1, k + 1) {
                // Such as y\\x; it stays a mistake where no axes follow.
                Err(error) if is_corner => {
                    header.corner = Some(error);
                    f64::NAN
                }
                value => value?,
            });
        }
        are_full &= empty == usize::from(ends_empty);
        let found = values.len() - before;
        if rows > 0 && found != columns {
            let problem = format!("has {found} fields in line {}, {columns} before", i + 1);
            return Err(Invalid::whole(NAME, problem, "give every row as many numbers"));
        }
        columns = found;
        rows += 1;
    }
    if rows == 0 {
        return Err(Invalid::whole(NAME, "holds no numbers", "give a matrix, one line per row"));
    }
    gaps.check(rows)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("every row has its fields");
    let columns = columns - usize::from(are_closed && are_full);
    let values = values.slice_move(s![.., ..columns]);
    if columns == 1 {
        let problem = "holds one column of numbers, no matrix";
        return Err(Invalid::whole(NAME, problem, "give a line per row of the map"));
    }
    check_size(NAME, rows, columns)?;
    Ok(Table { values, header, corner_is_empty })
}

/// Places at which blank lines or comments stand between two rows.
#[derive(Default)]
struct Gaps {
    is_open: bool,
    count: usize,
    /// Rows before the first one, and the number of the line after it.
    first: Option<(usize, usize)>,
}

impl Gaps {
    fn open(&mut self, rows: usize) {
        self.is_open |= rows > 0;
    }

    fn close(&mut self, rows: usize, line: usize) {
        if std::mem::take(&mut self.is_open) {
            self.count += 1;
            self.first.get_or_insert((rows, line));
        }
    }

    /// Refuses rows in several groups. A gap after every row separates nothing.
    fn check(&self, rows: usize) -> Result<(), Invalid> {
        match self.first {
            Some((before, line)) if self.count + 1 < rows => Err(Invalid::whole(
                NAME,
                format!(
                    "has {before} rows, then blank lines or comments, then more rows in line {line}"
                ),
                "give a file for each matrix, or delete the lines between the rows",
            )),
            _ => Ok(()),
        }
    }
}

/// Refuses a table that is certainly no matrix of heights alone.
fn refuse_other_tables(values: &Array2<f64>) -> Result<(), Invalid> {
    let (rows, columns) = values.dim();
    if columns == 3 && rows >= 3 * FEWEST {
        let problem = format!("has {rows} lines of 3 numbers, which are points x y z, no matrix");
        let remedy = "give `format` xyz; save a matrix of 3 columns as .npy";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    let is_axis = |own: Vec<f64>, next: Vec<f64>| {
        own.len() >= CERTAIN && is_uniform(&own) && !is_uniform(&next)
    };
    let is_y = is_axis(values.slice(s![1.., 0]).to_vec(), values.slice(s![1.., 1]).to_vec());
    if columns == 2 && rows >= CERTAIN {
        let problem = format!("has {rows} lines of 2 numbers, which are a profile, no map");
        let remedy = "planish-surface line reads it; save a matrix of 2 columns as .npy";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    let is_x = is_axis(values.slice(s![0, 1..]).to_vec(), values.slice(s![1, 1..]).to_vec());
    let which = match (is_x, is_y) {
        (false, false) => return Ok(()),
        (true, false) => "line goes",
        (false, true) => "column goes",
        (true, true) => "line and the first column go",
    };
    let problem = format!(
        "has coordinates or numbers of pixels beside its heights: the first {which} in equal steps"
    );
    let remedy = "give the coordinates x and y both, with an empty first field, or delete them; if they are heights, save \
                  them as .npy";
    Err(Invalid::whole(NAME, problem, remedy))
}

/// True where at least [`FEWEST`] numbers go in equal steps.
fn is_uniform(values: &[f64]) -> bool {
    let (Some(first), Some(last)) = (values.first(), values.last()) else { return false };
    let step = (last - first) / (values.len() as f64 - 1.0);
    let is_step = |w: &[f64]| ((w[1] - w[0]) / step - 1.0).abs() <= UNIFORMITY;
    values.len() >= FEWEST && step.is_finite() && step != 0.0 && values.windows(2).all(is_step)
}

/// Statements in the comments of a file.
#[derive(Default)]
struct Header {
    /// Reason to refuse the first field if it is a word.
    corner: Option<Invalid>,
    unit: Option<Unit>,
    /// Sizes along (x, y), as Gwyddion writes them, with their unit.
    size: [Option<(f64, Unit)>; 2],
    /// Sizes along (x, y) and units as SPIP writes them.
    length: [Option<f64>; 2],
    length_unit: [Option<Unit>; 2],
    nm_per_bit: Option<f64>,
    /// Pitch along (x, y), mm.
    pitch_mm: [Option<f64>; 2],
    /// Comments that speak of a unit or a pitch and are not used.
    unused: Vec<String>,
}

/// Words of a comment for the distance of pixels.
const PITCH: [&str; 8] = [
    "pixel size",
    "pixel pitch",
    "pixel spacing",
    "pixel",
    "pitch",
    "lateral resolution",
    "sampling",
    "spacing",
];

impl Header {
    fn add(&mut self, comment: &str, line: usize) -> Result<(), Invalid> {
        let Some((key, value)) = comment.split_once([':', '=']) else {
            let mut words = comment.split(|c: char| !c.is_alphanumeric());
            if words.any(|word| word.len() > 1 && Unit::stated("unit", word).is_ok()) {
                self.leave(comment, line);
            }
            return Ok(());
        };
        let (key, value) = (key.trim().to_lowercase(), value.trim());
        let number = |text: &str| text::number(NAME, text, line, 2);
        match key.as_str() {
            "unit" | "units" | "value units" | "value unit" | "z-unit" | "z unit" | "z units"
            | "height unit" | "height units" | "data unit" | "data units" => {
                let unit = Unit::stated("unit", value)?;
                if let Some(before) = self.unit.filter(|before| *before != unit) {
                    let problem = format!("states the units {before:?} and {unit:?}");
                    return Err(Invalid::whole(NAME, problem, "correct the comments"));
                }
                self.unit = Some(unit);
            }
            "width" | "height" => {
                // Other comments may begin with these words.
                let size_and_unit = value.split_once(char::is_whitespace);
                if let Some((Ok(size), unit)) = size_and_unit.map(|(v, u)| (v.parse(), u)) {
                    let unit = Unit::stated("coordinate_unit", unit)?;
                    self.size[usize::from(key == "height")] = Some((size, unit));
                }
            }
            "x-length" => self.length[0] = Some(number(value)?),
            "y-length" => self.length[1] = Some(number(value)?),
            "x-unit" => self.length_unit[0] = Some(Unit::stated("coordinate_unit", value)?),
            "y-unit" => self.length_unit[1] = Some(Unit::stated("coordinate_unit", value)?),
            "bit2nm" => self.nm_per_bit = Some(number(value)?),
            _ if self.add_pitch(&key, value)? => {}
            _ if ["unit", "pitch", "pixel size", "scale"].iter().any(|w| key.contains(w)) => {
                self.leave(comment, line);
            }
            _ => {}
        }
        Ok(())
    }

    /// Keeps a comment that is not used, for the warning.
    fn leave(&mut self, comment: &str, line: usize) {
        if self.unused.len() < MOST_QUOTED {
            let short = comment.trim().chars().filter(|c| !c.is_control()).take(60);
            self.unused.push(format!("\"{}\" (line {line})", short.collect::<String>()));
        }
    }

    /// True where a comment states a pitch with its unit, in the value or in brackets after the words, which is kept.
    fn add_pitch(&mut self, key: &str, value: &str) -> Result<bool, Invalid> {
        let (words, in_brackets) = key.split_once(['(', '[']).unwrap_or((key, ""));
        let words = words.trim().replace(['_', '-'], " ");
        let axis = [words.strip_prefix("x "), words.strip_prefix("y ")];
        let name = axis[0].or(axis[1]).unwrap_or(&words);
        if !PITCH.contains(&name) {
            return Ok(false);
        }
        let at = value.find(|c: char| !"+-.0123456789eE".contains(c)).unwrap_or(value.len());
        let in_value = value[at..].trim();
        let unit = [in_value, in_brackets.trim_end_matches([')', ']'])]
            .into_iter()
            .find(|unit| !unit.is_empty())
            .map(|unit| Unit::stated("coordinate_unit", unit));
        let (Ok(pitch), Some(Ok(unit))) = (value[..at].parse::<f64>(), unit) else {
            return Ok(false);
        };
        for (k, place) in self.pitch_mm.iter_mut().enumerate() {
            if axis[1 - k].is_none() {
                *place = Some(pitch * unit.mm()?);
            }
        }
        Ok(true)
    }

    fn apply(self, reading: &mut Reading) -> Result<(), Invalid> {
        let (rows, columns) = reading.values.dim();
        reading.unit = self.unit;
        if let Some(nm) = self.nm_per_bit {
            // SPIP writes one or the other; both together could mean two things.
            if nm != 1.0 && self.unit.is_some_and(|unit| unit != Unit::Nm) {
                let problem = format!("states Bit2nm = {nm} and z-unit {:?}", self.unit);
                return Err(Invalid::whole(NAME, problem, "delete the one that is wrong"));
            }
            reading.unit = self.unit.or(Some(Unit::Nm));
            reading.factor = nm;
        }
        let spip = |k: usize| Some((self.length[k]?, self.length_unit[k].unwrap_or(Unit::Nm)));
        let mut pitch = [None; 2];
        for (k, pixels) in [columns, rows].into_iter().enumerate() {
            if let Some((size, unit)) = self.size[k].or_else(|| spip(k)) {
                pitch[k] = Some(size * unit.mm()? / pixels as f64);
            }
        }
        if let ([Some(x), Some(y)], None) = (pitch, &reading.coordinates) {
            reading.pixel_mm = Some([x, y]);
            // Both programs write the picture from its top.
            reading.first_row = FirstRow::Top;
        } else if let ([Some(x), Some(y)], None) = (self.pitch_mm, &reading.coordinates) {
            reading.pixel_mm = Some([x, y]);
        }
        if !self.unused.is_empty() {
            let say = format!("comments that are not used: {}", self.unused.join(", "));
            reading.warnings.push(say);
        }
        Ok(())
    }
}
