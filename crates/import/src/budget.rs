//! Limits on the bytes, elements and work that one file may cost, whatever it claims of itself. Every
//! reader keeps these limits, and its message names the one that a file exceeds.
//!
//! A small file can ask for much: a header that claims gigabytes, zeros that inflate a thousandfold, a
//! group that contains itself. So memory is limited before it is allocated, by [`MOST_PIXELS`] and by the
//! memory of the process ([`planish_types::budget`]). Loops that a file steers are limited by counts,
//! because a library knows no clock.
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

/// Largest file that is read, bytes; a larger one is refused. Larger: more memory for files that hold no
/// map. Smaller: refuses large maps as text. Derived: a map of [`MOST_PIXELS`] pixels as text, 32 bytes
/// each.
pub const MOST_FILE_BYTES: u64 = 1 << 30;

/// Largest number of pixels of a map, or of elements of any array that is decoded; more are refused. Larger: a small
/// file can claim more memory. Smaller: refuses large maps. Chosen: about 5800 x 5800, more than any interferometer
/// has.
pub const MOST_PIXELS: usize = 1 << 25;

/// Memory that a pixel needs while a map is read, bytes. Larger: large maps are refused although they would
/// fit into the memory. Smaller: a map can exceed the memory of the process. Derived: five 64-bit numbers,
/// which are the value as stored, in nm, in the order of the file, in the order of the map, and as written.
pub(crate) const BYTES_PER_PIXEL: usize = 5 * 8;

/// Memory that a line `x y z` of a text needs while it is read, bytes. Larger: large files are refused although they
/// would fit. Smaller: a file can exceed the memory. Derived: five numbers in a list that takes three times as much
/// while it grows, three to sort the coordinates of an axis (8 bytes each), and the pixel.
pub(crate) const BYTES_PER_POINT: usize = 3 * 5 * 8 + 3 * 8 + BYTES_PER_PIXEL;

/// Largest number of samples (times with positions) of a machine log; more are refused. Larger: more memory for one
/// file. Smaller: refuses
/// long logs. Chosen: nine hours at 1 kHz.
pub(crate) const MOST_SAMPLES: usize = MOST_PIXELS;

/// Memory that a sample of a machine log needs while it is read, bytes. Larger: long logs are refused although they
/// would fit. Smaller: a log can exceed the memory. Derived: seven numbers in lists that take three times as much while
/// they grow, eight for times and positions (8 bytes each), and the segment of the motion with its copies.
pub(crate) const BYTES_PER_SAMPLE: usize = 3 * 7 * 8 + 8 * 8 + 3 * 96;

/// Largest number of parts of one file that are searched for the map: groups, arrays, images, blocks or variables. A
/// file with more is refused. Larger: more time on a hostile file. Smaller: refuses files that hold many arrays.
pub(crate) const MOST_ARRAYS: usize = 10_000;

/// Largest number of lines, or cards, of a header that are read. Larger: more memory for a hostile header. Smaller:
/// refuses long headers. Chosen: ten times the longest header of an observatory.
pub(crate) const MOST_HEADER_LINES: usize = 50_000;

/// Largest length of texts beside the numbers, bytes: of a header, a name, or the names in a table together. Longer
/// ones are refused or not read. Larger: more memory for a hostile file. Smaller: refuses files with many long names.
pub(crate) const MOST_TEXT_BYTES: usize = 1 << 18;

/// Largest number of reads from an HDF5 file; more are refused. Larger: a file that points to itself takes more time.
/// Smaller: refuses maps with small chunks. Derived: as many chunks of eight pixels as a map of [`MOST_PIXELS`] has.
pub(crate) const MOST_READS: u64 = 1 << 22;

/// Returns the largest number of elements that may be read if each needs `bytes_each` bytes: at most [`MOST_PIXELS`],
/// and no more than fit into the memory of the process.
pub(crate) fn most_of(bytes_each: usize) -> usize {
    MOST_PIXELS.min((budget::memory_bytes() / bytes_each as u64) as usize)
}

/// Refuses to read one more element after `count`, each of `bytes_each` bytes, if [`most_of`] such elements are there
/// already. `array` is the subject of the message.
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

/// Returns the number of pixels of a map of `rows` x `columns`. Refuses fewer than 2 x 2, more than [`MOST_PIXELS`],
/// and more than fit into the memory. `array` is the subject of the message.
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

/// Returns the number of elements of an array of this shape. Refuses more than [`MOST_PIXELS`], and more than fit into
/// the memory. `array` is the subject of the message.
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

/// Returns the message that the file called `file` holds more than `most` items of the kind `what`, with the remedy.
pub(crate) fn too_many(file: &'static str, most: usize, what: &str, remedy: &str) -> Invalid {
    Invalid::whole(file, format!("holds more than {most} {what}"), remedy)
}
