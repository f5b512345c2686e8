//! A matrix of numbers as text: one line per row, fields separated by comma, semicolon, tab or
//! white space. Lines that start with `#` are comments; an empty field, `nan`, `bad` or `no data`
//! is an invalid pixel.
//!
//! What a file says of itself is obeyed:
//!
//! * Comments `# Width: 15.0 mm`, `# Height: 10.0 mm` and `# Value units: m` as Gwyddion's export of text writes them, or
//!   `# unit: nm`: the pitch is width over columns, and the first row of an export of Gwyddion is the top.
//! * Comments `# x-length = 1000`, `# x-unit = nm`, `# z-unit = nm`, `# Bit2nm = 0.5` as in ASCII files of SPIP.
//! * A first line and a first column of coordinates: they ascend or descend in equal steps, and the corner is empty or a
//!   word. The coordinates have no unit.
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

/// Reads a matrix.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let mut values = Vec::new();
    let (mut rows, mut columns) = (0, 0);
    let most = most_of(BYTES_PER_PIXEL);
    let mut header = Header::default();
    let mut corner_is_empty = false;
    for (i, line) in text::text(NAME, bytes)?.lines().enumerate() {
        if line.trim().is_empty() {
            continue;
        }
        if let Some(comment) = line.trim_start().strip_prefix('#') {
            header.add(comment, i + 1)?;
            continue;
        }
        let before = values.len();
        for (k, field) in text::fields(line).enumerate() {
            if values.len() >= most {
                check_room(NAME, values.len(), BYTES_PER_PIXEL)?;
            }
            let is_corner = rows == 0 && k == 0;
            let is_word = field.parse::<f64>().is_err();
            corner_is_empty |= is_corner && is_word;
            values.push(match text::number(NAME, field, i + 1, k + 1) {
                // Such as y\\x; it stays a mistake where no axes follow.
                Err(error) if is_corner => {
                    header.corner = Some(error);
                    f64::NAN
                }
                value => value?,
            });
        }
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
    check_size(NAME, rows, columns)?;
    let values = Array2::from_shape_vec((rows, columns), values).expect("every row has its fields");
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
        Reading::new(Format::Csv, values, FirstRow::SmallestY)
    };
    if are_axes && !has_axes {
        reading.warnings.push(
            "the first line and the first column go in equal steps, as coordinates do, and are read as heights; if they are \
             coordinates, empty the first field"
                .into(),
        );
    } else if columns == 3 && rows >= 3 * FEWEST {
        let say = "lines of 3 numbers are read as a matrix of 3 columns; `format` xyz reads them as x y z";
        reading.warnings.push(say.into());
    }
    header.apply(&mut reading)?;
    Ok(reading)
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
}

impl Header {
    fn add(&mut self, comment: &str, line: usize) -> Result<(), Invalid> {
        let Some((key, value)) = comment.split_once([':', '=']) else { return Ok(()) };
        let (key, value) = (key.trim().to_lowercase(), value.trim());
        let number = |text: &str| text::number(NAME, text, line, 2);
        match key.as_str() {
            "unit" | "units" | "value units" | "value unit" | "z-unit" => {
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
            _ => {}
        }
        Ok(())
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
        }
        Ok(())
    }
}
