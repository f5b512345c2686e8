//! Moments in a log (dates with times of day, times of day, elapsed times): `2026-03-01T23:59:50.125Z`, `3/1/2026
//! 12:00:00.000`, `01.03.2026 12:00:00,5`, `23:59:59.900`.
//!
//! ```text
//! [date] hh:mm:ss[.fraction] [AM | PM] [Z | +hh:mm | -hh:mm | +hhmm | -hhmm]
//! ```
//!
//! The date is `2026-03-01`, `2026/03/01`, `1.3.2026`, `3/1/2026`, `1-3-2026` or `1-Mar-2026`; a T, a blank or a comma
//! follows it. A date with slashes or dashes whose year comes last has the month or the day first: the order that makes
//! the longest step between two samples the shortest is taken. Without a date, a time of day that falls by more than half
//! a day has passed midnight. Without a zone the moment is taken as UTC, as the other moments of the log are. Day numbers
//! are those of the proleptic Gregorian calendar (ISO 8601-1:2019, 4.2.1):
//!
//! ```text
//! days before year y = 365 y' + y'/4 - y'/100 + y'/400,    y' = y - 1
//! ```
//!
//! Seconds are kept as a whole number and a fraction, so that times since any year keep the resolution of the text.

/// A moment as a log writes it: date (if any), time of day, and the resolution of the text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moment {
    date: Option<Date>,
    /// Whole seconds since midnight (for `mm:ss` since the full hour) or elapsed, minus the offset of the time zone
    /// from UTC.
    seconds: i64,
    fraction: f64,
    /// Number of digits of the fraction.
    digits: u8,
    /// Seconds after which a time without a date starts again: a day, or an hour for `mm:ss`; 0 for an elapsed time of
    /// 24 h or more.
    period: i64,
}

/// The three numbers of a date and their order. Month names are numbers, and years of two digits begin at 2000. The
/// order is `None` if the month or the day may come first.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Date {
    numbers: [i64; 3],
    order: Option<Order>,
}

/// Order of the numbers of a date, by the one that comes first.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Order {
    Year,
    Month,
    Day,
}

impl Moment {
    /// Reads a moment from `text`, in one of the forms of the module; returns `None` for other text.
    pub fn read(text: &str) -> Option<Self> {
        let text = text.trim();
        if !text.is_ascii() || !text.contains(':') {
            return None;
        }
        let first = text.find(':')?;
        let (date, time) = match text[..first].rfind(['T', 't', ' ', ',']) {
            Some(end) => (Some(text[..end].trim_end_matches([',', ' '])), text[end + 1..].trim()),
            None => (None, text),
        };
        let date = match date {
            Some(date) => Some(Date::read(date)?),
            None => None,
        };
        let mut moment = Self::of_time(time, date.is_some())?;
        moment.date = date;
        Some(moment)
    }

    /// Reads a time of day, an elapsed time, or (without a date) `mm:ss.fraction`, as spreadsheets shorten it. With a
    /// date, `hh:mm` is read too. Returns `None` for other text.
    fn of_time(text: &str, has_date: bool) -> Option<Self> {
        let end = text.find(|c: char| !(c.is_ascii_digit() || ":.,".contains(c)));
        let (clock, rest) = text.split_at(end.unwrap_or(text.len()));
        let (whole, fraction) = match clock.split_once(['.', ',']) {
            Some((whole, fraction)) => (whole, Some(fraction)),
            None => (clock, None),
        };
        let mut parts = whole.split(':').map(|part| digits(part, 1..=3));
        let [a, b] = [parts.next()??, parts.next()??];
        let [c, d] = [parts.next(), parts.next()];
        if parts.next().is_some() || (d.is_some() && fraction.is_some()) {
            return None;
        }
        let is_short = c.is_none();
        let (hour, minute, second) = match c {
            Some(c) => (a, b, c?),
            None if has_date && fraction.is_none() => (a, b, 0),
            None if !has_date && fraction.is_some() => (0, a, b),
            None => return None,
        };
        // hh:mm:ss:fff
        let fraction = match d {
            Some(_) => whole.rsplit(':').next(),
            None => fraction,
        };
        let (fraction, digits_of_fraction) = match fraction {
            Some(text) if !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()) => {
                (format!("0.{text}").parse::<f64>().ok()?, u8::try_from(text.len()).ok()?)
            }
            Some(_) => return None,
            None => (0.0, 0),
        };
        let (hour, zone) = half_of_day(hour, rest.trim())?;
        // A leap second is the second 60.
        if minute > 59 || second > 60 || (has_date && hour > 23) {
            return None;
        }
        let seconds = 60 * (60 * hour + minute - zone_minutes(zone)?) + second;
        let period = match (is_short, hour) {
            (true, _) => 3600,
            (false, 0..=23) => 86_400,
            _ => 0,
        };
        Some(Self { date: None, seconds, fraction, digits: digits_of_fraction, period })
    }
}

/// Returns the hour, and the text after AM or PM. With AM or PM the hour becomes that of the day (0 to 23); without,
/// both stay as they are. Returns `None` if AM or PM follows an hour outside of 1 to 12.
fn half_of_day(hour: i64, text: &str) -> Option<(i64, &str)> {
    let Some(mark) = text.get(..2) else { return Some((hour, text)) };
    let added = match mark.to_ascii_uppercase().as_str() {
        "AM" => 0,
        "PM" => 12,
        _ => return Some((hour, text)),
    };
    if (1..=12).contains(&hour) { Some((hour % 12 + added, text[2..].trim())) } else { None }
}

/// Returns the minutes by which a time zone such as `Z` or `+02:00` is ahead of UTC, 0 for empty text; `None` for other
/// text.
fn zone_minutes(zone: &str) -> Option<i64> {
    if matches!(zone, "" | "Z" | "z" | "UTC" | "GMT") {
        return Some(0);
    }
    let sign = if zone.starts_with('-') { -1 } else { 1 };
    let offset = zone.strip_prefix(['+', '-'])?.replace(':', "");
    let (hours, minutes) = offset.split_at_checked(2)?;
    let minutes = if minutes.is_empty() { "00" } else { minutes };
    let [hours, minutes] = [digits(hours, 2..=2)?, digits(minutes, 2..=2)?];
    if hours > 23 || minutes > 59 { None } else { Some(sign * (60 * hours + minutes)) }
}

/// Beginnings of the names of the months in English, German and French, in lower case.
const MONTHS: [&[&str]; 12] = [
    &["jan"],
    &["feb", "fev"],
    &["mar", "maer", "mrz"],
    &["apr", "avr"],
    &["may", "mai"],
    &["jun", "juin"],
    &["jul", "juil"],
    &["aug", "aou"],
    &["sep"],
    &["oct", "okt"],
    &["nov"],
    &["dec", "dez"],
];

impl Date {
    fn read(text: &str) -> Option<Self> {
        let separator = text.chars().find(|c| "-/. ".contains(*c))?;
        let parts: Vec<&str> = text.split(separator).collect();
        let [a, b, c] = parts[..] else { return None };
        let date = if a.len() == 4 {
            let numbers = [digits(a, 4..=4)?, digits(b, 1..=2)?, digits(c, 1..=2)?];
            Self { numbers, order: Some(Order::Year) }
        } else {
            let year = match c.len() {
                4 => digits(c, 4..=4)?,
                _ => 2000 + digits(c, 2..=2)?,
            };
            let name = b.to_ascii_lowercase();
            let month = MONTHS.iter().position(|m| m.iter().any(|start| name.starts_with(start)));
            let order = if separator == '.' || month.is_some() { Some(Order::Day) } else { None };
            let month = match month {
                Some(month) => month as i64 + 1,
                None => digits(b, 1..=2)?,
            };
            Self { numbers: [digits(a, 1..=2)?, month, year], order }
        };
        let is_day = [Order::Month, Order::Day].iter().any(|o| date.day(*o).is_some());
        if is_day { Some(date) } else { None }
    }

    /// Returns the number of the day in the calendar, from day 0, the first of January of the year 1. `order` counts if
    /// the date leaves its order open. Returns `None` for a date that does not exist.
    fn day(&self, order: Order) -> Option<i64> {
        let [a, b, c] = self.numbers;
        let (year, month, day) = match self.order.unwrap_or(order) {
            Order::Year => (a, b, c),
            Order::Month => (c, a, b),
            Order::Day => (c, b, a),
        };
        if !(1..=12).contains(&month) || !(1..=days_of(year, month)).contains(&day) {
            return None;
        }
        let before: i64 = (1..month).map(|m| days_of(year, m)).sum();
        Some(days_before(year) + before + day - 1)
    }
}

/// Times that a column of moments stands for.
#[derive(Debug)]
pub struct Times {
    /// Seconds after the first moment, per sample (n), which need not ascend.
    pub seconds: Vec<f64>,
    /// Unit of the last digit of the moment with the most decimals, s.
    pub resolution_s: f64,
}

/// Returns the times of `moments` since the first one. If the dates leave their order open, it takes the order with the
/// shorter longest step. The error is the index of a moment whose date does not exist in either order, or of one with a
/// date after a first one without (or the other way round).
pub fn times(moments: &[Moment]) -> Result<Times, usize> {
    let digits = moments.iter().map(|m| m.digits).max().unwrap_or(0);
    let resolution_s = 10f64.powi(-i32::from(digits));
    let [month_first, day_first] = [Order::Month, Order::Day].map(|order| in_order(moments, order));
    let seconds = match (month_first, day_first) {
        (Ok(a), Ok(b)) => {
            if longest_step(&a) <= longest_step(&b) {
                a
            } else {
                b
            }
        }
        (Ok(only), Err(_)) | (Err(_), Ok(only)) => only,
        (Err(a), Err(b)) => return Err(a.max(b)),
    };
    Ok(Times { seconds, resolution_s })
}

/// Returns the seconds after the first moment, if dates that leave their order open have `order`. The error is that of
/// [`times`].
fn in_order(moments: &[Moment], order: Order) -> Result<Vec<f64>, usize> {
    let mut seconds = Vec::with_capacity(moments.len());
    let mut first: Option<(i64, f64)> = None;
    let mut day = 0;
    let mut before = None;
    for (i, moment) in moments.iter().enumerate() {
        let whole = match &moment.date {
            Some(date) if i == 0 || moments[0].date.is_some() => {
                86_400 * date.day(order).ok_or(i)? + moment.seconds
            }
            None if moments[0].date.is_none() => {
                if before.is_some_and(|before| before - moment.seconds > moment.period / 2) {
                    day += moment.period;
                }
                before = Some(moment.seconds);
                day + moment.seconds
            }
            _ => return Err(i),
        };
        let (whole_of_first, fraction_of_first) = *first.get_or_insert((whole, moment.fraction));
        seconds.push((whole - whole_of_first) as f64 + (moment.fraction - fraction_of_first));
    }
    Ok(seconds)
}

fn longest_step(seconds: &[f64]) -> f64 {
    seconds.windows(2).map(|t| (t[1] - t[0]).abs()).fold(0.0, f64::max)
}

/// Returns the number in `text` if it consists of digits, as many as `lengths` allows; `None` otherwise.
fn digits(text: &str, lengths: std::ops::RangeInclusive<usize>) -> Option<i64> {
    let are_digits = lengths.contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    if are_digits { text.parse().ok() } else { None }
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

/// Returns the number of days before the first of January of a year, in the proleptic Gregorian calendar.
fn days_before(year: i64) -> i64 {
    let y = year - 1;
    365 * y + y.div_euclid(4) - y.div_euclid(100) + y.div_euclid(400)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the seconds from the moment `start` to the moment `text`; `None` if one of them is no moment.
    fn after(start: &str, text: &str) -> Option<f64> {
        let both = [Moment::read(start)?, Moment::read(text)?];
        Some(times(&both).ok()?.seconds[1])
    }

    #[test]
    fn moments_are_seconds_of_the_calendar() {
        // Unix times of calendars.
        for (text, unix) in [
            ("2000-01-01T00:00:00Z", 946_684_800.0),
            ("2026-03-01T23:59:50.125Z", 1_772_409_590.125),
            ("2024-02-29 12:00:00,5", 1_709_208_000.5),
            ("2026-03-02T01:59:50+02:00", 1_772_409_590.0),
            ("2026-03-01T18:29:50-0530", 1_772_409_590.0),
            ("2016-12-31T23:59:60Z", 1_483_228_800.0),
            ("2026/03/01 23:59:50", 1_772_409_590.0),
            ("1.3.2026 23:59:50", 1_772_409_590.0),
            ("1-Mar-2026 11:59:50 PM", 1_772_409_590.0),
            ("01 M\u{61}i 2026 00:00:00", 1_777_593_600.0),
        ] {
            // Whole seconds and short fractions are exact.
            assert_eq!(after("1970-01-01T00:00:00Z", text), Some(unix), "{text}");
        }
        // The step of a microsecond, since any year, to the rounding of numbers below 1.
        let step = after("2026-03-01T12:00:00.000100Z", "2026-03-01T12:00:01.000200Z").unwrap();
        assert!((step - 1.0001).abs() < 4e-16, "{step}");
    }

    #[test]
    fn times_of_day_pass_midnight_and_dates_have_one_order() {
        let all = |texts: &[&str]| {
            let moments: Vec<Moment> = texts.iter().map(|t| Moment::read(t).unwrap()).collect();
            times(&moments).map(|times| times.seconds)
        };
        assert_eq!(all(&["23:59:59.5", "00:00:00.0", "00:00:00.5"]).unwrap(), [0.0, 0.5, 1.0]);
        assert_eq!(all(&["59:59.5", "00:00.5"]).unwrap(), [0.0, 1.0]);
        assert_eq!(all(&["23:59:59:500", "00:00:00:000"]).unwrap(), [0.0, 0.5]);
        assert_eq!(all(&["12:59:59 AM", "1:00:00 AM"]).unwrap(), [0.0, 1.0]);
        assert_eq!(all(&["25:00:00", "26:00:00"]).unwrap(), [0.0, 3600.0]);
        // The 2nd of March comes a day after the 1st, the 3rd of February a month after the 3rd of January.
        let over = all(&["3/1/2026 23:59:59", "3/2/2026 00:00:00"]).unwrap();
        assert_eq!(over, [0.0, 1.0]);
        assert_eq!(all(&["31/1/2026 23:59:59", "1/2/2026 00:00:00"]).unwrap(), [0.0, 1.0]);
        assert_eq!(all(&["13/1/2026 00:00:00", "1/13/2026 00:00:00"]), Err(1));
        assert_eq!(all(&["1/2/2026 00:00:00", "00:00:01"]), Err(1));
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
            "2026-03-01T00:00:0\u{e9}",
            "2026-03-01T00:00:00+1",
            "+026-03-01T00:00:00",
            "2026-03-01x00:00:00",
            "12:60:00",
            "1:2",
            "30.2.2026 00:00:00",
            "13:00:00 PM",
            "a:b:c",
            ":::",
        ] {
            assert_eq!(Moment::read(text), None, "{text}");
        }
    }
}
