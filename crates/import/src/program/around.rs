//! Text around the motion of a program that Planish wrote: its checksum, the words DRY RUN, the number of a part, and
//! the lines of the machine file.
//!
//! | comment | meaning |
//! |---|---|
//! | `checksum: crc32 XXXXXXXX of the lines below`, first line | CRC-32 of zlib over the lines below, each with a line feed |
//! | `DRY RUN: ...` | the tool stays off |
//! | `part K of N, ...` | the file is a part, and no program by itself |
//! | `after the part with the checksum crc32 XXXXXXXX` | checksum of the part before |
//! | `prologue of the machine file` to `end of the prologue` | lines that move nothing, before the motion |
//! | `epilogue of the machine file` to `end of the epilogue` | the same after the motion |
//!
//! A program without them is read as it stands. The lines of the machine file are not read as motion, but each must be
//! a line that a machine file may state ([`check_line`]). Before the prologue and after the epilogue nothing may move.

use std::borrow::Cow;

use planish_types::{AxesMotion, ControllerKind, Invalid, check_line};

use super::{Configuration, wrong};

/// Beginnings of lines, besides those of [`check_line`] and comments, that may stand before a prologue.
const OPENING: [&str; 5] = ["%", "PROGRAM", "OPEN", "CLOSE", "&"];

/// Lines that may stand after an epilogue.
const CLOSING: [&str; 6] = ["G94 F60", "M2", "M30", "%", "END PROGRAM", "CLOSE"];

/// Comments in the head of a program.
#[derive(Debug, Default)]
pub(super) struct Head {
    pub is_dry_run: bool,
    /// Number of the part, and number of parts.
    pub part: Option<[usize; 2]>,
    /// Checksum of the part before, in the head of a part.
    after: Option<String>,
}

/// Returns the comments of the head of a program. Refuses a text whose checksum is not that of its first line.
pub(super) fn head(text: &str) -> Result<Head, Invalid> {
    let mut head = Head::default();
    let mut is_sealed = false;
    for (i, line) in text.lines().enumerate() {
        let Some(words) = comment(line) else { break };
        if let Some(stated) = digits(words, "checksum: crc32 ").filter(|_| i == 0) {
            is_sealed = true;
            let found = checksum(text);
            if stated != found {
                let problem = format!(
                    "is {stated} in the first line, and that of the lines below is {found}"
                );
                let remedy = "export it again: it was changed or cut off; or take the first line off if the change is \
                              meant";
                return Err(Invalid::whole("checksum", problem, remedy));
            }
        }
        head.is_dry_run |= words.starts_with("DRY RUN");
        // Another program's file may speak of parts, too.
        let numbers = words.strip_prefix("part ").and_then(|w| w.split_once(" of "));
        if let Some(numbers) = numbers.filter(|_| is_sealed) {
            let of = numbers.1.split(',').next().unwrap_or_default();
            head.part = numbers.0.parse().ok().zip(of.parse().ok()).map(|(k, n)| [k, n]);
        }
        let before = digits(words, "after the part with the checksum crc32 ");
        head.after = before.map(str::to_string).or(head.after);
    }
    Ok(head)
}

/// Returns the words of a line that is a comment as Planish writes it; `None` for another line.
fn comment(line: &str) -> Option<&str> {
    const OPENING: [char; 6] = ['\'', '(', ';', '#', '/', '*'];
    let line = line.trim().strip_prefix(OPENING)?;
    Some(line.trim_start_matches(OPENING).trim_end_matches([')', '*']).trim())
}

/// Returns the eight hexadecimal digits after `before`, if `words` begin so.
fn digits<'a>(words: &'a str, before: &str) -> Option<&'a str> {
    words.strip_prefix(before)?.get(..8)
}

/// Returns the CRC-32 of the lines below the first one.
fn checksum(text: &str) -> String {
    let mut hasher = crc32fast::Hasher::new();
    for line in text.lines().skip(1) {
        hasher.update(line.as_bytes());
        hasher.update(b"\n");
    }
    format!("{:08x}", hasher.finalize())
}

/// Returns the text of a program whose parts are `texts`, in their order. Refuses a part that was changed, is missing
/// or in the wrong place, and files that are no parts of a program without a stop. The index of the part
/// comes with the error.
pub(super) fn joined(texts: &[Cow<str>]) -> Result<String, (usize, Invalid)> {
    let mut whole = String::new();
    let mut before = None;
    for (i, text) in texts.iter().enumerate() {
        let head = head(text).map_err(|e| (i, e))?;
        let remedy = "give all parts of one program, in their order";
        if head.part != Some([i + 1, texts.len()]) {
            let is = match head.part {
                Some([k, n]) => format!("is part {k} of {n}"),
                None => "is no part of a program that runs without a stop".into(),
            };
            let problem = format!("{is}, and stands as number {} of {}", i + 1, texts.len());
            return Err((i, Invalid::at_index("part", i + 1, problem, remedy)));
        }
        if head.after != before {
            let [stated, found] = [&head.after, &before].map(|c| c.clone().unwrap_or_default());
            let problem = format!(
                "follows the part with the checksum {stated}, and that before it has {found}"
            );
            return Err((i, Invalid::at_index("part", i + 1, problem, remedy)));
        }
        before = Some(checksum(text));
        let is_of_part = |line: &&str| {
            let words = comment(line).unwrap_or_default();
            ["checksum: ", "part ", "after the part "].iter().any(|w| words.starts_with(w))
        };
        for line in text.lines().filter(|line| !is_of_part(line)) {
            whole += line;
            whole.push('\n');
        }
    }
    Ok(whole)
}

/// Returns the text with blank lines in place of those of the machine file. Refuses lines that a machine file may not
/// state, a prologue within or after the motion, an epilogue before its end, and one that does not end.
pub(super) fn without_machine_lines(
    controller: ControllerKind,
    text: &str,
) -> Result<Cow<'_, str>, Invalid> {
    if !text.contains("of the machine file") {
        return Ok(Cow::Borrowed(text));
    }
    let mut block = None;
    let mut is_after = false;
    let mut plain = String::with_capacity(text.len());
    let mut assigned = Vec::new();
    let mut moves = false;
    for (i, line) in text.lines().enumerate() {
        let words = comment(line);
        match (block, words) {
            (None, Some("prologue of the machine file")) if moves => {
                return Err(wrong(
                    i + 1,
                    "begins the prologue of the machine file within the motion",
                ));
            }
            (None, Some("prologue of the machine file")) => block = Some("end of the prologue"),
            (None, Some("epilogue of the machine file")) => block = Some("end of the epilogue"),
            (Some(end), Some(words)) if words == end => {
                is_after = end == "end of the epilogue";
                block = None;
            }
            (Some(_), _) => {
                check_line(controller, line).map_err(|(problem, remedy)| {
                    Invalid::at_index("program line", i + 1, problem, remedy)
                })?;
                assigned.push(line);
            }
            (None, None) if is_after => {
                let is_known = line.trim().is_empty() || CLOSING.contains(&line.trim());
                if !is_known {
                    return Err(wrong(i + 1, "goes on after the epilogue of the machine file"));
                }
                plain += line;
            }
            (None, None) => {
                let upper = line.trim().to_uppercase();
                let is_opening = OPENING.iter().any(|word| upper.starts_with(word));
                moves |=
                    !(upper.is_empty() || is_opening || check_line(controller, &upper).is_ok());
                plain += line;
            }
            (None, Some(_)) => plain += line,
        }
        plain.push('\n');
    }
    if let Some(end) = block {
        let problem = format!("has no line {end:?}");
        return Err(Invalid::whole(
            "program",
            problem,
            "export it again: it was changed or cut off",
        ));
    }
    check_outputs(controller, &assigned, &plain)?;
    Ok(Cow::Owned(plain))
}

/// Refuses lines of the machine file that switch the tool of a PMAC program on.
fn check_outputs(controller: ControllerKind, lines: &[&str], motion: &str) -> Result<(), Invalid> {
    if controller != ControllerKind::Pmac {
        return Ok(());
    }
    for line in lines {
        let compact = line.to_uppercase().replace(' ', "");
        let Some((output, value)) = compact.split_once('=').filter(|(o, _)| o.starts_with('M'))
        else {
            continue;
        };
        let switch = format!("{output}==");
        if value != "0" && motion.to_uppercase().contains(&switch) {
            let problem =
                format!("has the line {line:?} of the machine file, and {output} is the tool");
            let remedy = "take it out of the machine file, and export again";
            return Err(Invalid::whole("program", problem, remedy));
        }
    }
    Ok(())
}

/// Returns the motion with the tool off throughout for a dry run, and during run-up and run-down, which
/// `configuration` states, if the program itself does not switch the tool.
pub(super) fn with_tool(
    motion: AxesMotion,
    head: &Head,
    configuration: &Configuration,
) -> Result<AxesMotion, Invalid> {
    let is_dry_run = head.is_dry_run || configuration.dry_run;
    let is_switched = motion.tool_on().iter().any(|on| !on);
    let excerpt = configuration.excerpt.unwrap_or_default();
    let is_short = excerpt.run_up_s > 0.0 || excerpt.run_down_s > 0.0;
    if !(is_dry_run || is_short && !is_switched) {
        return Ok(motion);
    }
    let t = motion.break_time_s();
    let total_s = motion.total_time_s();
    let tool_on = (0..motion.len()).map(|i| {
        let middle_s = 0.5 * (t[i] + t[i + 1]) - t[0];
        let is_inside = middle_s > excerpt.run_up_s && middle_s < total_s - excerpt.run_down_s;
        !is_dry_run && is_inside
    });
    AxesMotion::new(
        t.to_vec(),
        (0..motion.len()).flat_map(|i| motion.segment(i).to_vec()).collect(),
        tool_on.collect(),
        motion.dwell_index().to_vec(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "; prologue of the machine file\nDWELL2000\n; end of the prologue\n";
    const TAIL: &str = "; epilogue of the machine file\nM2=0\n; end of the epilogue\n";

    fn message(text: &str) -> String {
        without_machine_lines(ControllerKind::Pmac, text).unwrap_err().to_string()
    }

    #[test]
    fn lines_of_the_machine_file_are_blank() {
        let text = format!("; x\nCLOSE\nOPEN PROG 5 CLEAR\n{HEAD}ABS\nPVT1\nX1:0\n{TAIL}CLOSE\n");
        let plain = without_machine_lines(ControllerKind::Pmac, &text).unwrap();
        assert_eq!(plain.lines().count(), text.lines().count());
        let words: Vec<&str> = plain.lines().filter(|line| !line.is_empty()).collect();
        assert_eq!(words, ["; x", "CLOSE", "OPEN PROG 5 CLEAR", "ABS", "PVT1", "X1:0", "CLOSE"]);
    }

    #[test]
    fn what_moves_in_the_wrong_place_is_refused() {
        let within = format!("ABS\nPVT1\nX1:0\n{HEAD}X2:0\n");
        assert!(message(&within).contains("line[4]: begins the prologue"), "{}", message(&within));
        let after = format!("{HEAD}ABS\nPVT1\nX1:0\n{TAIL}X2:0\n");
        assert!(message(&after).contains("line[10]: goes on after"), "{}", message(&after));
        let open = HEAD.replace("; end of the prologue\n", "");
        assert!(
            message(&open).contains("has no line \"end of the prologue\""),
            "{}",
            message(&open)
        );
        let moving = HEAD.replace("DWELL2000", "X5:0");
        assert!(message(&moving).contains("line[2]: is \"X5:0\""), "{}", message(&moving));
        let on = HEAD.replace("DWELL2000", "M1=1") + "M1==1\nPVT1\nX1:0\nM1==0\nDWELL0\n";
        assert!(message(&on).contains("M1 is the tool"), "{}", message(&on));
    }

    fn part(k: usize, after: Option<&str>, body: &str) -> String {
        let after = after
            .map_or(String::new(), |c| format!("# after the part with the checksum crc32 {c}\n"));
        let rest = format!("# part {k} of 2, joined without a stop\n{after}{body}");
        let crc = checksum(&format!("\n{rest}"));
        format!("# checksum: crc32 {crc} of the lines below\n{rest}")
    }

    #[test]
    fn parts_join_in_their_order_only() {
        let first = part(1, None, "0,1\n");
        let crc = first[18..26].to_string();
        let second = part(2, Some(&crc), "1,2\n");
        let join =
            |texts: &[&str]| joined(&texts.iter().map(|t| Cow::Borrowed(*t)).collect::<Vec<_>>());
        assert_eq!(join(&[&first, &second]).unwrap(), "0,1\n1,2\n");
        let said = |texts: &[&str]| join(texts).unwrap_err().1.to_string();
        assert!(
            said(&[&second, &first]).contains("part[1]: is part 2 of 2, and stands as number 1")
        );
        assert!(said(&[&first, &first]).contains("part[2]: is part 1 of 2"));
        assert!(said(&[&first]).contains("part[1]: is part 1 of 2, and stands as number 1 of 1"));
        let other = part(2, Some("00000000"), "1,2\n");
        assert!(said(&[&first, &other]).contains("follows the part with the checksum 00000000"));
        assert!(said(&[&first, &second.replace("1,2", "1,3")]).contains("checksum: is"));
        assert!(said(&["0,1\n", &second]).contains("is no part"));
    }
}
