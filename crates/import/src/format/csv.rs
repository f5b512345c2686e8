//! A matrix of numbers as text: one line per row, fields separated by comma, semicolon, tab or
//! white space, with a decimal point, or with a decimal comma where that is certain. Lines that start with `#` or `%`
//! are comments; an empty field, `nan`, `bad`, `#N/A` or another word for no data is an invalid pixel. A
//! separator at the end of a line closes it if all lines end so and no field is empty; otherwise an empty field follows
//! it.
//!
//! What a file says of itself is obeyed (`crate::beside`):
//!
//! * Comments `# Width: 15.0 mm`, `# Height: 10.0 mm` and `# Value units: m` as Gwyddion's export of text writes them in any
//!   language, or `# unit: nm`: the pitch is width over columns, and the first row of an export of Gwyddion is the top.
//! * Comments `# x-length = 1000`, `# x-unit = nm`, `# z-unit = nm`, `# Bit2nm = 0.5` as in ASCII files of SPIP.
//! * Comments `# pixel size: 0.5 mm`, `# pitch (um) = 500`: the pitch along x and y.
//! * Lines of text above the numbers, such as `"XY Calibration","500","um"` and `"Unit","nm"` of a Keyence microscope, whose
//!   first row is the top.
//! * A first line and a first column of coordinates: they ascend or descend in equal steps, and the corner is empty or a
//!   word. The coordinates have no unit.
//!
//! A statement that speaks of a unit or a pitch and is not understood is a warning. Text that is no matrix of heights is
//! refused: coordinates or row numbers beside heights, lines `x y z`, profiles, and several matrices one after the other.
//!
//! Source: the manuals of Gwyddion ("Export", text matrix) and SPIP ("ASCII file format"); files of a Keyence VK-X.

use ndarray::{Array2, ArrayView1, s};
use planish_types::Invalid;

use super::srw;
use crate::{
    Format,
    beside::{self, Beside},
    budget::{BYTES_PER_PIXEL, MOST_HEADER_LINES, check_room, check_size, most_of, too_many},
    reading::{Coordinates, FirstRow, Reading},
    text,
};

const NAME: &str = "CSV file";

/// Largest departure of a step of a coordinate axis from the mean step, as a fraction. Axes are written with few
/// digits. Larger: heights pass as an axis. Smaller: rounded axes are missed.
const UNIFORMITY: f64 = 0.01;

/// Smallest number of values that can be an axis of coordinates. Smaller: three values lie in equal steps by chance.
const FEWEST: usize = 4;

/// Smallest number of values in equal steps that are certainly coordinates, if the next row or column has no equal
/// steps. Larger: coordinates of small maps are read as heights. Smaller: whole numbers that are heights are refused by
/// chance.
const CERTAIN: usize = 8;

/// Reads a map from a matrix of numbers.
///
/// # Errors
/// Refuses rows of different lengths, words among the numbers, several matrices, and one column. Refuses tables that
/// are certainly no matrix of heights, and a table of SRW.
pub fn read(bytes: &[u8]) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let (header, first) = header(&text)?;
    let body = from_line(&text, first);
    let with_points = text::with_points(NAME, body)?;
    let Table { values, comments, corner, corner_is_empty } =
        table(with_points.as_deref().unwrap_or(body), first, header)?;
    let (rows, columns) = values.dim();
    let x = values.slice(s![0, 1..]).to_vec();
    let y = values.slice(s![1.., 0]).to_vec();
    let are_axes = is_uniform(&x) && is_uniform(&y);
    let has_axes = corner_is_empty && are_axes;
    if let Some(error) = corner.filter(|_| !has_axes) {
        return Err(error);
    }
    if are_axes && !has_axes && srw::is_srw(body) {
        let problem = "has 0 in its corner, between a first line and a first column of coordinates";
        let remedy = "give `format` srw for a height map of SRW, with y along the first line; empty the corner where x goes \
                      along it";
        return Err(Invalid::whole(NAME, problem, remedy));
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
    if comments.is_keyence {
        reading.first_row = FirstRow::Top;
    }
    comments.beside.apply(&mut reading)?;
    if !comments.lines.is_empty() {
        reading.stated = serde_json::json!({ "header": comments.lines });
    }
    Ok(reading)
}

/// Statements above and between the numbers of the matrix, in comments and text lines.
#[derive(Default)]
struct Comments {
    beside: Beside,
    /// Text lines above the numbers, as the manifest records them; at most [`MOST_LINES`].
    lines: Vec<String>,
    is_keyence: bool,
}

/// Largest number of fields of a line that are looked at to tell text from numbers. Larger: more memory for a long
/// line. Smaller: words further to the right are missed.
const MOST_FIELDS: usize = 1 << 16;

/// Largest number of text lines above the numbers that the manifest keeps. Larger: longer manifests.
const MOST_LINES: usize = 40;

/// Returns the statements of the text lines above the numbers, and the number of lines up to the last of them. A text
/// line has a word in its first field. It belongs to the matrix if its other fields are numbers, and the next line has
/// as many fields. Refuses too many text lines.
fn header(text: &str) -> Result<(Comments, usize), Invalid> {
    let mut header = Comments::default();
    let mut first = 0;
    let mut comments = Vec::new();
    let mut lines = text.lines().enumerate().peekable();
    while let Some((i, line)) = lines.next() {
        if line.trim().is_empty() || text::is_comment(line) {
            if text::is_comment(line) && comments.len() < MOST_HEADER_LINES {
                comments.push((i, line));
            }
            continue;
        }
        let fields: Vec<&str> = text::fields(line).take(MOST_FIELDS).collect();
        let next = lines.peek().map(|(_, next)| text::fields(next).take(MOST_FIELDS).count());
        // Decimal commas may split a line of numbers at the wrong places.
        let is_corner = fields.len() > 2
            && !fields[1..].iter().any(|field| is_word(field))
            && next == Some(fields.len());
        if !fields.first().is_some_and(|field| is_word(field)) || is_corner {
            break;
        }
        if i >= MOST_HEADER_LINES {
            let remedy = "give a matrix, one line per row";
            return Err(too_many(NAME, MOST_HEADER_LINES, "lines of text", remedy));
        }
        for (k, comment) in comments.drain(..) {
            header
                .beside
                .add_comment(comment.trim_start().trim_start_matches(['#', '%']), k + 1)?;
        }
        header.is_keyence |= fields[0].eq_ignore_ascii_case("XY Calibration")
            || fields
                .get(1)
                .is_some_and(|model| model.starts_with("VK-") || model.starts_with("VR-"));
        match beside::key_and_value(line) {
            Some(_) if fields.len() == 1 => header.beside.add_comment(line, i + 1)?,
            _ => header.beside.add_fields(&fields, i + 1)?,
        }
        if header.lines.len() < MOST_LINES {
            let short = line.chars().filter(|c| !c.is_control()).take(120);
            header.lines.push(short.collect());
        }
        first = i + 1;
    }
    Ok((header, first))
}

/// Returns the text after its first `lines` lines; it is empty if the text has fewer.
fn from_line(text: &str, lines: usize) -> &str {
    match lines.checked_sub(1).and_then(|n| text.match_indices('\n').nth(n)) {
        Some((end, _)) => &text[end + 1..],
        None if lines == 0 => text,
        None => "",
    }
}

/// Returns true if the field is neither a number nor a mark for no data, and one of its words is neither of them.
fn is_word(field: &str) -> bool {
    is_text(field) && field.split_whitespace().any(is_text)
}

/// Returns true if the text is neither a number nor a mark for no data, such as `nan`; an empty text is such a mark.
fn is_text(word: &str) -> bool {
    !is_numeric(word) && !text::is_no_data(word)
}

/// Returns true if the field is a number with a decimal point or a decimal comma.
fn is_numeric(field: &str) -> bool {
    field.parse::<f64>().is_ok() || field.replacen(',', ".", 1).parse::<f64>().is_ok()
}

/// The numbers of a text, and the statements above and between them.
struct Table {
    values: Array2<f64>,
    comments: Comments,
    /// Reason to refuse the first field of the matrix, if that is a word; coordinates in the first row and column make
    /// it harmless.
    corner: Option<Invalid>,
    corner_is_empty: bool,
}

/// Reads the numbers of a text. `before` is the number of lines of the file before `text`, for messages, and `comments`
/// are the statements in them. Refuses rows of different lengths, words (but for the first field), several matrices,
/// and one column.
fn table(text: &str, before: usize, mut comments: Comments) -> Result<Table, Invalid> {
    let mut values = Vec::new();
    let mut rows = 0;
    let mut columns = 0;
    let most = most_of(BYTES_PER_PIXEL);
    let mut corner = None;
    let mut corner_is_empty = false;
    // True while all lines end with a separator, and while no field before it is empty.
    let mut are_closed = true;
    let mut are_full = true;
    let mut gaps = Gaps::default();
    for (i, line) in text.lines().enumerate().map(|(i, line)| (i + before, line)) {
        // A tab may be a separator: a line of tabs is a row of invalid pixels.
        let is_blank = line.trim_matches([' ', '\r']).is_empty();
        if is_blank || text::is_comment(line) {
            gaps.open(rows);
            if !is_blank {
                let comment = line.trim_start().trim_start_matches(['#', '%']);
                comments.beside.add_comment(comment, i + 1)?;
            }
            continue;
        }
        gaps.close(rows, i + 1);
        let count = values.len();
        let is_closed = text::is_closed(line);
        are_closed &= is_closed;
        let mut empty = 0usize;
        let mut ends_empty = false;
        let last = if is_closed { Some("") } else { None };
        for (k, field) in text::fields(line).chain(last).enumerate() {
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
                    corner = Some(error);
                    f64::NAN
                }
                value => value?,
            });
        }
        are_full &= empty == usize::from(ends_empty);
        let fields = values.len() - count;
        if rows > 0 && fields != columns {
            let problem = format!("has {fields} fields in line {}, {columns} before", i + 1);
            return Err(Invalid::whole(NAME, problem, "give every row as many numbers"));
        }
        columns = fields;
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
    Ok(Table { values, comments, corner, corner_is_empty })
}

/// Blank lines or comments between rows of the matrix: how many such gaps there are, and where the first one is.
#[derive(Default)]
struct Gaps {
    is_open: bool,
    count: usize,
    /// Number of rows of the matrix before the first gap, and the number of the line of the file after it.
    first: Option<(usize, usize)>,
}

impl Gaps {
    /// Records a line that is no row of the matrix, after `rows` rows.
    fn open(&mut self, rows: usize) {
        self.is_open |= rows > 0;
    }

    /// Records a row of the matrix in line `line` of the file, after `rows` rows.
    fn close(&mut self, rows: usize, line: usize) {
        if std::mem::take(&mut self.is_open) {
            self.count += 1;
            self.first.get_or_insert((rows, line));
        }
    }

    /// Refuses a matrix of `rows` rows in which gaps separate groups of rows. Gaps after every row are accepted.
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

/// Returns true if the row or column `own` has at least [`CERTAIN`] values in equal steps, and its neighbour `next` has
/// no equal steps.
fn is_axis(own: ArrayView1<f64>, next: ArrayView1<f64>) -> bool {
    own.len() >= CERTAIN && is_uniform(&own.to_vec()) && !is_uniform(&next.to_vec())
}

/// Refuses a table that is certainly something else than heights: 12 lines or more of 3 numbers (points x y z), 8 lines
/// or more of 2 (a profile), or coordinates in the first row or column.
fn refuse_other_tables(values: &Array2<f64>) -> Result<(), Invalid> {
    let (rows, columns) = values.dim();
    if columns == 3 && rows >= 3 * FEWEST {
        let problem = format!("has {rows} lines of 3 numbers, which are points x y z, no matrix");
        let remedy = "give `format` xyz; save a matrix of 3 columns as .npy";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    let is_y = is_axis(values.slice(s![1.., 0]), values.slice(s![1.., 1]));
    if columns == 2 && rows >= CERTAIN {
        let problem = format!("has {rows} lines of 2 numbers, which are a profile, no map");
        let remedy = "planish surface line reads it; save a matrix of 2 columns as .npy";
        return Err(Invalid::whole(NAME, problem, remedy));
    }
    let is_x = is_axis(values.slice(s![0, 1..]), values.slice(s![1, 1..]));
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

/// Returns true if there are at least [`FEWEST`] values, and they ascend or descend in equal steps to within
/// [`UNIFORMITY`].
fn is_uniform(values: &[f64]) -> bool {
    let (Some(first), Some(last)) = (values.first(), values.last()) else { return false };
    let step = (last - first) / (values.len() as f64 - 1.0);
    values.len() >= FEWEST
        && step.is_finite()
        && step != 0.0
        && values.windows(2).all(|w| ((w[1] - w[0]) / step - 1.0).abs() <= UNIFORMITY)
}
