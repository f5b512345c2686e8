//! Moments of ISO 8601 in a log: `2026-03-01T23:59:50.125Z`.
//!
//! ```text
//! YYYY-MM-DDThh:mm:ss[.fraction][Z | +hh:mm | -hh:mm | +hhmm | -hhmm]
//! ```
//!
//! A blank may stand in the place of the T, and a comma in that of the decimal point. Without a zone the moment is taken
//! as UTC, as the other moments of the log are. The day number is that of the proleptic Gregorian calendar (ISO
//! 8601-1:2019, 4.2.1):
//!
//! ```text
//! days before year y = 365 y' + y'/4 - y'/100 + y'/400,    y' = y - 1
//! ```

/// Years from whose beginning the seconds count. Its distance decides the rounding: 1e9 s as a 64-bit float has steps of
/// 1e-7 s.
const FIRST_YEAR: i64 = 2000;

/// Seconds from the beginning of the year 2000 in UTC; `None` for text that is no moment.
pub fn seconds(text: &str) -> Option<f64> {
    let text = text.trim();
    if !text.is_ascii() || text.len() < 19 {
        return None;
    }
    let (date, rest) = text.split_at(10);
    let [year, month, day] = fields(date, '-', [4, 2, 2])?;
    let time = rest.strip_prefix(['T', 't', ' '])?;
    let (clock, rest) = time.split_at_checked(8)?;
    let [hour, minute, second] = fields(clock, ':', [2, 2, 2])?;
    let (fraction, zone) = match rest.strip_prefix(['.', ',']) {
        None => (0.0, rest),
        Some(rest) => {
            let end = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
            let digits = Some(&rest[..end]).filter(|d| !d.is_empty())?;
            (format!("0.{digits}").parse::<f64>().ok()?, &rest[end..])
        }
    };
    let zone_minutes = match zone {
        "" | "Z" | "z" => 0,
        _ => {
            let sign = if zone.starts_with('-') { -1 } else { 1 };
            let offset = zone.strip_prefix(['+', '-'])?.replace(':', "");
            let (hours, minutes) = offset.split_at_checked(2)?;
            let minutes = if minutes.is_empty() { "00" } else { minutes };
            let [hours, minutes] = [digits(hours, 2)?, digits(minutes, 2)?];
            if hours > 23 || minutes > 59 {
                return None;
            }
            sign * (60 * hours + minutes)
        }
    };
    // A leap second is the second 60.
    let is_day = (1..=12).contains(&month) && (1..=days_of(year, month)).contains(&day);
    if !is_day || hour > 23 || minute > 59 || second > 60 {
        return None;
    }
    let before: i64 = (1..month).map(|m| days_of(year, m)).sum();
    let days = days_before(year) - days_before(FIRST_YEAR) + before + day - 1;
    let minutes = 60 * (24 * days + hour) + minute - zone_minutes;
    Some((60 * minutes + second) as f64 + fraction)
}

/// Three numbers of these many digits with a separator between them.
fn fields(text: &str, separator: char, lengths: [usize; 3]) -> Option<[i64; 3]> {
    let mut parts = text.split(separator);
    let mut next = |length| digits(parts.next()?, length);
    let found = [next(lengths[0])?, next(lengths[1])?, next(lengths[2])?];
    parts.next().is_none().then_some(found)
}

fn digits(text: &str, length: usize) -> Option<i64> {
    let are_digits = text.len() == length && text.bytes().all(|b| b.is_ascii_digit());
    are_digits.then(|| text.parse().ok()).flatten()
}

fn is_leap(year: i64) -> bool {
    year % 4 == 0 && (year % 100 != 0 || year % 400 == 0)
}

fn days_of(year: i64, month: i64) -> i64 {
    match month {
        2 => 28 + i64::from(is_leap(year)),
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

/// Days before the first of January of a year.
fn days_before(year: i64) -> i64 {
    let y = year - 1;
    365 * y + y.div_euclid(4) - y.div_euclid(100) + y.div_euclid(400)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_seconds_of_the_calendar() {
        // 946684800 is the Unix time of 2000-01-01T00:00:00Z; the others are Unix times of calendars.
        for (text, unix) in [
            ("2000-01-01T00:00:00Z", 946_684_800.0),
            ("1970-01-01T00:00:00Z", 0.0),
            ("2026-03-01T23:59:50.125Z", 1_772_409_590.125),
            ("2024-02-29 12:00:00,5", 1_709_208_000.5),
            ("2026-03-02T01:59:50+02:00", 1_772_409_590.0),
            ("2026-03-01T18:29:50-0530", 1_772_409_590.0),
            ("2016-12-31T23:59:60Z", 1_483_228_800.0),
        ] {
            // Rounding of 1e9 s.
            let found = seconds(text).unwrap_or_else(|| panic!("{text}"));
            assert!((found + 946_684_800.0 - unix).abs() < 1e-6, "{text}: {found}");
        }
    }

    #[test]
    fn what_is_no_moment_has_no_seconds() {
        for text in [
            "",
            "12.5",
            "2026-03-01",
            "2026-13-01T00:00:00",
            "2025-02-29T00:00:00",
            "2026-03-01T24:00:00",
            "2026-03-01T00:00:00.",
            "2026-03-01T00:00:00+99:00",
            "2026-03-01T00:00:00Q",
            "2026-3-1T00:00:00.000",
            "2026-03-01T00:00:0\u{e9}",
            "2026-03-01T00:00:00+1",
            "+026-03-01T00:00:00",
            "2026-03-01x00:00:00",
        ] {
            assert_eq!(seconds(text), None, "{text}");
        }
    }
}
