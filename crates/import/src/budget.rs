//! What one file may cost: bytes, elements and work, whatever it claims of itself. Every reader is held
//! to these numbers, and says which one a file exceeds.
//!
//! A small file can ask for much: a header that claims gigabytes, zeros that inflate a thousandfold, a
//! group that contains itself. So memory is bounded before it is taken, by [`MOST_PIXELS`] and by what
//! the process may take ([`planish_types::budget`]), and loops that a file steers are bounded by counts:
//! a library knows no clock.
//!
//! | budget | of | bounds |
//! |---|---|---|
//! | [`MOST_FILE_BYTES`] | the file | what is read from the disk |
//! | [`MOST_PIXELS`], `--memory-gib` | a map, or any array that is decoded | memory |
//! | [`MOST_SAMPLES`], `--memory-gib` | a log | memory |
//! | [`MOST_ARRAYS`] | groups, arrays and images that a file lists | time, memory |
//! | [`MOST_HEADER_LINES`] | a header of text | memory |
//! | [`MOST_TEXT_BYTES`] | names and words beside the numbers | memory |
//! | [`MOST_READS`] | visits of an HDF5 file, which points to and fro within itself | time |

use planish_types::{Invalid, budget};

/// Largest file that is read, bytes: as text, a map of the most pixels.
pub const MOST_FILE_BYTES: u64 = 1 << 30;

/// Most pixels of a map: 5800 x 5800, more than any interferometer has.
pub const MOST_PIXELS: usize = 1 << 25;

/// What a pixel costs until it is written: its number as stored, and in nm, in the order of the file and
/// in that of the map, each for a moment beside the next, and the one that is written.
pub(crate) const BYTES_PER_PIXEL: usize = 5 * 8;

/// What a line `x y z` costs: three numbers in a list that doubles as it grows, their coordinates in
/// order, and the pixel.
pub(crate) const BYTES_PER_POINT: usize = 3 * 3 * 8 + BYTES_PER_PIXEL;

/// Most samples of a log: nine hours at 1 kHz.
pub(crate) const MOST_SAMPLES: usize = MOST_PIXELS;

/// What a sample of a log costs until it is written: seven columns in lists that double as they grow, times,
/// positions, and a piece of the motion, for a moment twice.
pub(crate) const BYTES_PER_SAMPLE: usize = 3 * 7 * 8 + 8 * 8 + 3 * 96;

/// Most groups, arrays and images that are looked at in one file to find the map.
pub(crate) const MOST_ARRAYS: usize = 10_000;

/// Most lines of a header: ten times the longest header of an observatory.
pub(crate) const MOST_HEADER_LINES: usize = 50_000;

/// Most bytes of names and words, all together; also of the header of one array.
pub(crate) const MOST_TEXT_BYTES: usize = 1 << 18;

/// Most reads of pieces of an HDF5 file: as many chunks of eight pixels as [`MOST_PIXELS`] has.
pub(crate) const MOST_READS: u64 = 1 << 22;

/// Most elements that may be read where one costs `bytes_each`: they fit into the memory too.
pub(crate) fn most_of(bytes_each: usize) -> usize {
    MOST_PIXELS.min((budget::memory_bytes() / bytes_each as u64) as usize)
}

/// Whether one more may be read than `count`, where one costs `bytes_each`.
pub(crate) fn check_room(
    array: &'static str,
    count: usize,
    bytes_each: usize,
) -> Result<(), Invalid> {
    if count < most_of(bytes_each) {
        return Ok(());
    }
    check_elements(array, &[count as u64 + 1])?;
    budget::affordable(array, (count + 1) as f64, bytes_each, "crop it").map(drop)
}

/// Whether a map of this size may be read; `array` names what claims it.
pub(crate) fn check_size(
    array: &'static str,
    rows: usize,
    columns: usize,
) -> Result<usize, Invalid> {
    if rows < 2 || columns < 2 {
        let problem = format!("has {rows} rows x {columns} columns");
        return Err(Invalid::whole(array, problem, "a map has at least 2 x 2"));
    }
    check_elements(array, &[rows as u64, columns as u64])
}

/// Whether an array of this shape may be decoded.
pub(crate) fn check_elements(array: &'static str, shape: &[u64]) -> Result<usize, Invalid> {
    let n = shape.iter().try_fold(1u64, |n, s| n.checked_mul(*s));
    match n.filter(|n| *n <= MOST_PIXELS as u64) {
        Some(n) => budget::affordable(array, n as f64, BYTES_PER_PIXEL, "crop it"),
        None => Err(Invalid::whole(
            array,
            match shape {
                [n] => format!("has {n} numbers or more"),
                [rows, columns] => format!("claims {rows} rows x {columns} columns"),
                _ => format!("claims the shape {shape:?}"),
            },
            format!("a map has at most {MOST_PIXELS} pixels; crop it, or check the header"),
        )),
    }
}

/// A file holds more than `most` of `what`.
pub(crate) fn too_many(file: &'static str, most: usize, what: &str, remedy: &str) -> Invalid {
    Invalid::whole(file, format!("holds more than {most} {what}"), remedy)
}
