//! The rows of a submission: time, position and velocity.

use planish_types::{Invalid, Trajectory};

/// Header of a submission.
const HEADER: &str = "t,x,y,vx,vy";

/// Largest time between two rows, s. A longer one is taken for missing rows. Larger: gaps pass. Smaller: long stays
/// need more rows.
pub const LONGEST_STEP_S: f64 = 1.0;

/// Returns the motion of a submission: cubics through the rows `t,x,y,vx,vy` (s, mm, mm/s), with the tool on.
///
/// # Errors
/// Refuses another header, rows that are not five finite numbers, and fewer than two rows. Refuses a first time other
/// than 0, times that do not ascend, two rows of one time (a jump), and more than [`LONGEST_STEP_S`] between two rows
/// (a gap).
pub fn trajectory(text: &str) -> Result<Trajectory, Invalid> {
    let mut lines = text.lines();
    let header = lines.next().unwrap_or_default().trim().replace(' ', "");
    if header != HEADER {
        let problem = format!("is {header:?}");
        return Err(Invalid::at_index("line", 1, problem, format!("give the header {HEADER}")));
    }
    let mut rows: Vec<[f64; 5]> = Vec::new();
    for (k, line) in lines.enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let row = row(line)
            .map_err(|problem| refusal(k, problem, "give t,x,y,vx,vy in s, mm and mm/s"))?;
        if let Some(last) = rows.last() {
            check_step(last, &row).map_err(|(problem, remedy)| refusal(k, problem, remedy))?;
        } else if row[0] != 0.0 {
            let problem = format!("starts at {} s", row[0]);
            return Err(refusal(k, problem, "start the motion at 0 s"));
        }
        rows.push(row);
    }
    if rows.len() < 2 {
        let problem = format!("are {}", rows.len());
        return Err(Invalid::whole("rows", problem, "give at least two"));
    }
    let cubics = rows.windows(2).map(|pair| [1, 2].map(|axis| cubic(&pair[0], &pair[1], axis)));
    let segments = rows.len() - 1;
    Trajectory::new(
        rows.iter().map(|row| row[0]).collect(),
        cubics.collect(),
        vec![true; segments],
        vec![None; segments],
    )
}

/// Returns the refusal of the row after the header that is number k from 0.
fn refusal(k: usize, problem: String, remedy: &str) -> Invalid {
    Invalid::at_index("line", k + 2, problem, remedy)
}

/// Returns the five numbers of a line; what is wrong with it if they are not.
fn row(line: &str) -> Result<[f64; 5], String> {
    let words: Vec<&str> = line.split(',').map(str::trim).collect();
    let Ok(words): Result<[&str; 5], _> = words.try_into() else {
        return Err(format!("is {line:?}, not five numbers"));
    };
    let mut row = [0.0; 5];
    for ((value, word), name) in row.iter_mut().zip(words).zip(HEADER.split(',')) {
        *value = match word.parse() {
            Ok(number) if f64::is_finite(number) => number,
            _ => return Err(format!("has {name} = {word:?}, which is no finite number")),
        };
    }
    Ok(row)
}

/// Returns what is wrong with the time between two rows, and the remedy.
fn check_step(last: &[f64; 5], row: &[f64; 5]) -> Result<(), (String, &'static str)> {
    let [before, after] = [last[0], row[0]];
    if after == before {
        let jump_mm = (row[1] - last[1]).hypot(row[2] - last[2]);
        let problem = format!("repeats the time {after} s: the motion jumps by {jump_mm} mm");
        return Err((problem, "give one row per time"));
    }
    if after < before {
        let problem = format!("has the time {after} s after {before} s");
        return Err((problem, "give the rows in the order of their times"));
    }
    // A step that is the limit but for rounding is no gap.
    if after - before > LONGEST_STEP_S * (1.0 + 1e-9) {
        let problem = format!("is {} s after the row before it, at {before} s", after - before);
        return Err((problem, "leave no gap in time: give a row at least every second"));
    }
    Ok(())
}

/// Returns the coefficients of (1) of the module above for an axis (1 or 2) between two rows.
fn cubic(start: &[f64; 5], end: &[f64; 5], axis: usize) -> [f64; 4] {
    let h = end[0] - start[0];
    let [v0, v1] = [start[axis + 2], end[axis + 2]];
    let mean = (end[axis] - start[axis]) / h;
    [start[axis], v0, (3.0 * mean - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * mean) / (h * h)]
}
