//! Units in the text of files of other programs: the one table for all readers.
//!
//! ```text
//! value in SI = mantissa 10^exponent x value in the unit
//! ```
//!
//! The power of ten is apart from the mantissa: from nm to nm is then exactly 1, from um to mm the number that is
//! written 1e-3.
//!
//! [`Unit::read`] reads a word, [`Header::read`] the name of a column such as `x (mm)`, `z[um]`, `height_nm`,
//! `Höhe / nm` or `rate_nm_per_min`. A word in brackets, after a slash or after "in" claims to be a unit: it is an
//! [`UnknownUnit`] if the table does not have it, never "no unit". The last word after a blank or `_` may also belong
//! to the name (`x_actual`): it is a unit only if the table has it.
//!
//! Lower and upper case count where a prefix depends on them: `mm` and `MM` are millimetres, `Mm` is refused.

use std::fmt;

use serde::{Serialize, Serializer};

use crate::Invalid;

/// Kind of quantity that a unit measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Length, SI unit m.
    Length,
    /// Wavelengths of light. Their length is the wavelength of the instrument.
    Waves,
    /// Interference fringes. The height of one depends on the wavelength and on the interferometer.
    Fringes,
    /// Pixels of a camera, or indices of samples along an axis.
    Pixels,
    /// Counts of an encoder.
    Counts,
    /// Angle or slope, SI unit rad.
    Angle,
    /// Time, SI unit s.
    Time,
    /// Sampling periods of a controller, as a measure of time.
    Samples,
    /// Number without a unit, such as the numerator of 1/s.
    One,
    /// Length per time, SI unit m/s: a velocity or a removal rate.
    LengthPerTime,
    /// Wavelengths of light per time.
    WavesPerTime,
    /// Angle per time, SI unit rad/s.
    AnglePerTime,
    /// Inverse of a time, SI unit 1/s.
    PerTime,
    /// Length per squared time, SI unit m/s^2.
    Acceleration,
    /// Angle per squared time, SI unit rad/s^2.
    AngularAcceleration,
}

/// A unit without a denominator: its symbol, its size and its spellings. The size in SI units is `mantissa`
/// 10^`exponent`.
#[derive(Debug)]
struct Word {
    quantity: Quantity,
    symbol: &'static str,
    mantissa: f64,
    exponent: i32,
    /// Spellings in addition to the symbol, separated by `|`. They are in lower case, unless the case decides.
    spellings: &'static str,
}

const fn word(
    quantity: Quantity,
    symbol: &'static str,
    mantissa: f64,
    exponent: i32,
    spellings: &'static str,
) -> Word {
    Word { quantity, symbol, mantissa, exponent, spellings }
}

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Numerator of units such as "per minute".
static ONE: Word = word(Quantity::One, "1", 1.0, 0, "");

/// All units without a denominator. For a spelling with two meanings (`"`, `min`), the first one that the reader wants
/// applies, else the first.
static WORDS: [Word; 36] = {
    use Quantity::{Acceleration, Angle, Counts, Fringes, Length, Pixels, Samples, Time, Waves};
    [
        word(Length, "m", 1.0, 0, "meter|meters|metre|metres|mètre|mètres|mtr"),
        word(
            Length,
            "mm",
            1.0,
            -3,
            "millimeter|millimeters|millimetre|millimetres|millimètre|millimètres|millimetern",
        ),
        word(
            Length,
            "um",
            1.0,
            -6,
            "u|micron|microns|mikron|micrometer|micrometers|micrometre|micrometres|micromètre|micromètres|\
             mikrometer|mikrometern",
        ),
        word(
            Length,
            "nm",
            1.0,
            -9,
            "nanometer|nanometers|nanometre|nanometres|nanomètre|nanomètres|nanometern",
        ),
        word(Length, "pm", 1.0, -12, "picometer|picometers|picometre|picometres|pikometer"),
        word(
            Length,
            "angstrom",
            1.0,
            -10,
            "A|å|angstroms|angstroem|angström|ångström|ångströms|ångstrom|ang",
        ),
        word(Length, "kangstrom", 1.0, -7, "kA|kå|kiloangstrom|kiloangstroms"),
        word(
            Length,
            "cm",
            1.0,
            -2,
            "centimeter|centimeters|centimetre|centimetres|centimètre|centimètres|zentimeter",
        ),
        word(Length, "dm", 1.0, -1, "decimeter|decimeters|decimetre|dezimeter|décimètre"),
        word(Length, "km", 1.0, 3, "kilometer|kilometers|kilometre|kilometres|kilomètre"),
        word(Length, "in", 254.0, -4, "in.|inch|inches|zoll|pouce|pouces|\"|\u{201d}|\u{2033}|''"),
        word(Length, "mil", 254.0, -7, "mils|thou|thous|milliinch|milli-inch"),
        word(
            Length,
            "uin",
            254.0,
            -10,
            "uin.|uinch|microinch|microinches|micro-inch|u\"|mikrozoll",
        ),
        word(Length, "ft", 3048.0, -4, "foot|feet|fuss|fuß|pied|pieds"),
        word(
            Waves,
            "waves",
            1.0,
            0,
            "wave|wv|wvs|wav|lambda|lambdas|λ|wl|wellen|wellenlänge|wellenlängen|onde|ondes",
        ),
        word(Fringes, "fringes", 1.0, 0, "fringe|fr|frs|streifen|frange|franges"),
        word(Pixels, "pixels", 1.0, 0, "pixel|pix|px|pxl"),
        word(Counts, "counts", 1.0, 0, "count|cts|cnt|cnts|inc|increments|inkremente|pulses"),
        word(Angle, "rad", 1.0, 0, "radian|radians|radiant"),
        word(Angle, "mrad", 1.0, -3, "milliradian|milliradians|milliradiant"),
        word(Angle, "urad", 1.0, -6, "microradian|microradians|mikroradiant|microrad"),
        word(Angle, "nrad", 1.0, -9, "nanoradian|nanoradians|nanoradiant|nanorad"),
        word(Angle, "deg", DEGREE, 0, "degree|degrees|°|º|Grad|degré|degrés|degs"),
        word(
            Angle,
            "arcmin",
            DEGREE / 60.0,
            0,
            "arcminute|arcminutes|arc min|amin|winkelminute|winkelminuten|'|\u{2032}|min",
        ),
        word(
            Angle,
            "arcsec",
            DEGREE / 3600.0,
            0,
            "arcsecond|arcseconds|arc sec|arcsecs|asec|as|winkelsekunde|winkelsekunden|\"|\u{201d}|\u{2033}|''|sec",
        ),
        word(
            Angle,
            "mas",
            DEGREE / 3600.0,
            -3,
            "marcsec|milliarcsec|milliarcsecond|milliarcseconds",
        ),
        word(
            Time,
            "s",
            1.0,
            0,
            "sec|sec.|secs|second|seconds|sekunde|sekunden|seconde|secondes|sek",
        ),
        word(
            Time,
            "ms",
            1.0,
            -3,
            "msec|msecs|millisecond|milliseconds|millisekunde|millisekunden|milliseconde|millisecondes|milli|millis",
        ),
        word(
            Time,
            "us",
            1.0,
            -6,
            "usec|usecs|microsecond|microseconds|mikrosekunde|mikrosekunden|microseconde|microsecondes|micros",
        ),
        word(
            Time,
            "ns",
            1.0,
            -9,
            "nsec|nsecs|nanosecond|nanoseconds|nanosekunde|nanosekunden|nanoseconde|nanosecondes|nanos",
        ),
        word(Time, "min", 60.0, 0, "min.|mins|minute|minutes|minuten|mn"),
        word(Time, "h", 3600.0, 0, "hr|hrs|hour|hours|stunde|stunden|std|heure|heures"),
        word(Time, "d", 86400.0, 0, "day|days|tag|tage|jour|jours"),
        word(Samples, "samples", 1.0, 0, "sample|ticks|tick|cycles|abtastwerte"),
        word(Acceleration, "g", 9.80665, 0, "g0|gn"),
        word(Quantity::AnglePerTime, "rpm", DEGREE * 6.0, 0, "u/min|tr/min"),
    ]
};

/// Words that separate numerator and denominator of a unit.
const PER: [&str; 3] = [" per ", " pro ", " par "];

/// Words in brackets that are remarks and no units, separated by `|`.
const NO_UNITS: &str = "|-|--|x|y|z|actual|act|feedback|fbk|encoder|measured|command|commanded|cmd|setpoint|\
 set|target|reference|ref|raw|ist|soll|abs|absolute|rel|relative|position|pos|height|time|zeit|filtered|\
 corrected|optional|utc|local";

/// Names of columns of heights, separated by `|`. After one of these a lone `A` at the end of a name is the angstrom,
/// and no axis.
const HEIGHTS: &str = "z|h|w|height|heights|thickness|depth|sag|film|error|figure|surface|removal|profile|\
 data|map|opd|rate|roughness|höhe|hoehe|dicke|hauteur|épaisseur";

/// A unit: a unit without a denominator, or one over a time or a squared time.
#[derive(Clone, Copy, Debug)]
pub struct Unit {
    numerator: &'static Word,
    per: Option<(&'static Word, u8)>,
}

impl PartialEq for Unit {
    fn eq(&self, other: &Self) -> bool {
        self.symbols() == other.symbols()
    }
}

impl Eq for Unit {}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.numerator.symbol)?;
        match self.per {
            None => Ok(()),
            Some((time, 1)) => write!(f, "/{}", time.symbol),
            Some((time, power)) => write!(f, "/{}^{power}", time.symbol),
        }
    }
}

impl Serialize for Unit {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl Unit {
    /// Returns the unit that `text` names, also in brackets, or `None` if the table does not have it. A word with two
    /// meanings gets the first meaning that is in `wanted`: `"` is an inch, but an arc second where an angle is wanted.
    pub fn read(text: &str, wanted: &[Quantity]) -> Option<Self> {
        let plain = normalised(text);
        let plain = unbracketed(&plain);
        if let Some(numerator) = find(plain, wanted) {
            return Some(Self { numerator, per: None });
        }
        quotient(plain, wanted)
    }

    /// Returns the symbol of the numerator, and the symbol and the power of the denominator, or `None` if there is no
    /// denominator.
    fn symbols(&self) -> (&str, Option<(&str, u8)>) {
        (self.numerator.symbol, self.per.map(|(time, power)| (time.symbol, power)))
    }

    /// Returns the kind of quantity that the unit measures.
    pub fn quantity(&self) -> Quantity {
        use Quantity::{
            Acceleration, Angle, AnglePerTime, AngularAcceleration, Length, LengthPerTime, One,
            PerTime, Waves, WavesPerTime,
        };
        let Some((_, power)) = self.per else { return self.numerator.quantity };
        match (self.numerator.quantity, power) {
            (Length, 1) => LengthPerTime,
            (Length, _) => Acceleration,
            (Angle, 1) => AnglePerTime,
            (Angle, _) => AngularAcceleration,
            (Waves, _) => WavesPerTime,
            (One, _) => PerTime,
            _ => unreachable!("`quotient` makes no other"),
        }
    }

    /// Returns the numerator of a quotient such as nm of `nm/min`, or the unit itself if it is no quotient.
    pub fn numerator(&self) -> Self {
        Self { numerator: self.numerator, per: None }
    }

    /// Returns the number of seconds in the time of the denominator: 60 for `nm/min`, 1 for `nm/s`, `None` for `nm`.
    pub fn per_s(&self) -> Option<f64> {
        self.per.map(|(time, _)| scaled(time.mantissa, time.exponent))
    }

    /// Returns the size of the unit in 10^`exponent` SI units. With -9 it is in nm, with -3 in mm, mm/s or mm/s^2. A
    /// rate in `um/h` has the size 1/3.6 nm/s with -9.
    pub fn size(&self, exponent: i32) -> f64 {
        let own = scaled(self.numerator.mantissa, self.numerator.exponent - exponent);
        match self.per {
            None => own,
            Some((time, power)) => {
                own / scaled(time.mantissa, time.exponent).powi(i32::from(power))
            }
        }
    }
}

/// Returns `mantissa` 10^`exponent` with a single rounding, because both factors are exact.
fn scaled(mantissa: f64, exponent: i32) -> f64 {
    // 10^22 is the largest power of ten that a double holds exactly; the table needs less.
    let power = 10f64.powi(exponent.abs());
    if exponent < 0 { mantissa / power } else { mantissa * power }
}

/// Returns `text` with one sign in place of several that look alike, and one blank in place of separators of words.
fn normalised(text: &str) -> String {
    let text =
        text.trim().replace("A\u{30a}", "å").replace("a\u{30a}", "å").replace("e\u{300}", "è");
    let plain: String = text
        .chars()
        .map(|c| match c {
            '\u{b5}' | '\u{3bc}' => 'u',
            '\u{212b}' | '\u{c5}' => 'å',
            '\u{3bb}' => 'λ',
            '\u{2019}' => '\'',
            '\u{a0}' | '\u{202f}' | '\u{2009}' | '_' | '\t' => ' ',
            '\u{2212}' => '-',
            '\u{b7}' | '\u{22c5}' => '*',
            '\u{2215}' | '\u{2044}' => '/',
            c => c,
        })
        .collect();
    plain.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Pairs of brackets that may stand around a unit.
const BRACKETS: [[char; 2]; 4] = [['(', ')'], ['[', ']'], ['{', '}'], ['<', '>']];

/// Returns the text inside brackets that enclose all of `text`, or `text` if there are none.
fn unbracketed(text: &str) -> &str {
    let mut insides =
        BRACKETS.iter().filter_map(|[open, close]| text.strip_prefix(*open)?.strip_suffix(*close));
    insides.next().map_or(text, str::trim)
}

/// Returns the unit of the table that is spelled `text`, which is normalised. Of several it is the first whose quantity
/// is in `wanted`, or the first of all if none is. `None` if no unit is spelled so.
fn find(text: &str, wanted: &[Quantity]) -> Option<&'static Word> {
    let mut words = WORDS.iter().filter(|word| is_spelled(word, text));
    let first = words.clone().next();
    words.find(|word| wanted.contains(&word.quantity)).or(first)
}

/// Returns true if `text` is the symbol or a spelling of `word`. Case does not matter in whole words and in symbols
/// that are in capitals throughout. A capital M before small letters would be the prefix mega.
fn is_spelled(word: &Word, text: &str) -> bool {
    let is_exact = text == word.symbol || is_among(text, word.spellings);
    if is_exact {
        return true;
    }
    let lower = text.to_lowercase();
    let is_capital = text.chars().all(|c| !c.is_lowercase());
    let is_mega = text.starts_with('M')
        && !is_capital
        && matches!(lower.as_str(), "mm" | "ms" | "mrad" | "mas");
    // `A`, `kA` (angstrom) and a lone `D`, `H`, `G` are other things in the other case.
    let needs_case = matches!(text, "a" | "ka" | "KA" | "Ka" | "D" | "G" | "U");
    !is_mega && !needs_case && (lower == word.symbol || is_among(&lower, word.spellings))
}

/// Returns true if `text` is one of the words in `list`, which are separated by `|`.
fn is_among(text: &str, list: &str) -> bool {
    list.split('|').any(|word| word == text)
}

/// Reads a unit over a time: `nm/min`, `mm s^-1`, `mm/s2`, `m/s/s`, `nm per minute`, `per minute`, `1/s`. `None` if the
/// text is none.
fn quotient(text: &str, wanted: &[Quantity]) -> Option<Unit> {
    let spaced = format!(" {text} ");
    let lower = spaced.to_lowercase();
    let (numerator, denominator, is_inverse) = if let Some((a, b)) = text.split_once('/') {
        (a, b, false)
    } else if let Some((start, mark)) = PER.iter().find_map(|mark| Some((lower.find(mark)?, *mark)))
    {
        // The lower case has other lengths than the text only beyond ASCII.
        (spaced.get(..start)?, spaced.get(start + mark.len()..)?, false)
    } else {
        let (a, b) = text.rsplit_once([' ', '*', '.'])?;
        (a, b, true)
    };
    let denominator = unbracketed(denominator.trim());
    let (time, power) = time_power(denominator, is_inverse)?;
    let numerator = match numerator.trim().trim_end_matches('*').trim() {
        "" | "1" => &ONE,
        name => {
            let numerators = [Quantity::Length, Quantity::Angle];
            let is_wanted = wanted.iter().any(|q| {
                matches!(
                    q,
                    Quantity::AnglePerTime | Quantity::AngularAcceleration | Quantity::Angle
                )
            });
            find(unbracketed(name), if is_wanted { &numerators[1..] } else { &numerators })?
        }
    };
    let is_quotient = match numerator.quantity {
        Quantity::Length | Quantity::Angle => true,
        Quantity::Waves | Quantity::One => power == 1,
        _ => false,
    };
    if is_quotient { Some(Unit { numerator, per: Some((time, power)) }) } else { None }
}

/// Reads the time and its power in a denominator: `s`, `min`, `s2`, `s^2`, `s/s`. With `is_inverse`, the power has a
/// minus sign: `s-1`, `s^-2`.
fn time_power(text: &str, is_inverse: bool) -> Option<(&'static Word, u8)> {
    let plain = text
        .replace('\u{b2}', "2")
        .replace('\u{207b}', "-")
        .replace('\u{b9}', "1")
        .replace("**", "^");
    let (name, power) = match plain.split_once('/') {
        Some((a, b)) if a.trim() == b.trim() => (a.trim().to_string(), 2),
        Some(_) => return None,
        None => {
            let end = plain.trim_end_matches(|c: char| c.is_ascii_digit() || c == '-' || c == '^');
            let power = plain[end.len()..].trim_start_matches('^');
            let power = match (power, is_inverse) {
                ("", false) | ("1", false) | ("-1", true) => 1,
                ("2", false) | ("-2", true) => 2,
                _ => return None,
            };
            (end.trim().to_string(), power)
        }
    };
    let (name, power) =
        match name.strip_suffix(" squared").or_else(|| name.strip_suffix(" per second")) {
            Some(name) => (name.to_string(), 2),
            None => (name, power),
        };
    let time = find(&name, &[Quantity::Time])?;
    if time.quantity == Quantity::Time { Some((time, power)) } else { None }
}

/// A word where a unit should be that the table of units does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownUnit {
    /// Text that contains the word, such as the name of a column.
    pub text: String,
    /// Word that is no known unit.
    pub word: String,
}

impl UnknownUnit {
    /// Returns the error about `subject`. `remedy` names the setting with which the user can state the unit instead of
    /// the file.
    pub fn refused(&self, subject: &'static str, remedy: impl Into<String>) -> Invalid {
        let [text, word] =
            [&self.text, &self.word].map(|text| text.chars().take(40).collect::<String>());
        let problem = if text == word {
            format!("is \"{word}\", which is no known unit")
        } else {
            format!("is \"{word}\" in \"{text}\", which is no known unit")
        };
        Invalid::whole(subject, problem, remedy.into())
    }
}

/// The name of a column or of a variable, with its unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Name of the column without its unit.
    pub name: String,
    /// Unit of the column; `None` if the text names none.
    pub unit: Option<Unit>,
}

impl Header {
    /// Splits `text` into name and unit. `wanted` are the quantities that the reader expects of this column; they
    /// decide between two meanings (`x_min` is the least x, `time_min` a time in minutes).
    ///
    /// # Errors
    /// A word in brackets, after a slash or after "in" that is no unit of the table.
    pub fn read(text: &str, wanted: &[Quantity]) -> Result<Self, UnknownUnit> {
        let text = text.trim().trim_matches('"').trim();
        if let Some(header) = bracketed(text, wanted)? {
            return Ok(header);
        }
        if let Some(header) = last_words(text, wanted) {
            return Ok(header);
        }
        for (name, word) in [split_at_in(text), text.rsplit_once('/')].into_iter().flatten() {
            let [name, word] = [name.trim(), word.trim()];
            if name.is_empty() || is_no_unit(word) {
                continue;
            }
            let unit = Unit::read(word, wanted);
            let unknown = UnknownUnit { text: text.into(), word: word.into() };
            return Ok(Self { name: name.into(), unit: Some(unit.ok_or(unknown)?) });
        }
        Ok(Self { name: text.into(), unit: None })
    }
}

/// Splits a text at its last " in ", in lower or upper case.
fn split_at_in(text: &str) -> Option<(&str, &str)> {
    let start = text.to_lowercase().rfind(" in ")?;
    // The lower case has other lengths than the text only beyond ASCII.
    Some((text.get(..start)?, text.get(start + 4..)?))
}

/// Returns true if a word where a unit could be is none: a number, or a remark such as `actual`.
fn is_no_unit(word: &str) -> bool {
    let lower = word.trim().to_lowercase();
    is_among(&lower, NO_UNITS) || lower.parse::<f64>().is_ok()
}

/// Reads the last unit in brackets, anywhere in `text`, that the table has. `None` if the text has no brackets with a
/// unit.
fn bracketed(text: &str, wanted: &[Quantity]) -> Result<Option<Header>, UnknownUnit> {
    let mut unknown = None;
    let mut end = text.len();
    while let Some(close) = text[..end].rfind([')', ']', '}', '>']) {
        let Some(pair) = BRACKETS.iter().find(|pair| text[close..].starts_with(pair[1])) else {
            break;
        };
        let Some(open) = text[..close].rfind(pair[0]) else {
            end = close;
            continue;
        };
        let inside = text[open + 1..close].trim();
        let first = inside.split([',', ';']).next().unwrap_or_default().trim();
        if let Some(unit) = Unit::read(inside, wanted).or_else(|| Unit::read(first, wanted)) {
            let name = format!("{} {}", text[..open].trim(), text[close + 1..].trim());
            return Ok(Some(Header { name: name.trim().into(), unit: Some(unit) }));
        }
        if !is_no_unit(inside) && unknown.is_none() {
            unknown = Some(UnknownUnit { text: text.into(), word: inside.into() });
        }
        end = open;
    }
    unknown.map_or(Ok(None), Err)
}

/// Largest number of words of a unit: "millimetres per second per second".
const MOST_WORDS: usize = 5;

/// Reads a unit from the last words of `text`, after a blank or `_`. It takes the longest one that the table has and
/// that cannot belong to the name; `None` if there is none.
fn last_words(text: &str, wanted: &[Quantity]) -> Option<Header> {
    let starts: Vec<usize> = text.match_indices(['_', ' ', '\t']).map(|(i, _)| i + 1).collect();
    for start in starts.iter().skip(starts.len().saturating_sub(MOST_WORDS)) {
        let (name, word) =
            (text[..start - 1].trim_end_matches(['_', ' ', '/', '-', ':']), &text[*start..]);
        // "Zeit / min" is a time in minutes, no rate.
        let Some(unit) = Unit::read(word, wanted).filter(|_| !word.starts_with('/')) else {
            continue;
        };
        if !name.is_empty() && is_unit_of(name, word, unit, wanted) {
            let name =
                name.strip_suffix(" in").or_else(|| name.strip_suffix("_in")).unwrap_or(name);
            return Some(Header { name: name.into(), unit: Some(unit) });
        }
    }
    None
}

/// Returns true if the last word of a column name is a unit, and no part of the name: `height_A` is in angstrom,
/// `pos_A` is an axis; `time_min` is in minutes, `x_min` a minimum.
fn is_unit_of(name: &str, word: &str, unit: Unit, wanted: &[Quantity]) -> bool {
    let quantity = unit.quantity();
    match word.trim() {
        "A" => {
            let last = name.rsplit(['_', ' ']).next().unwrap_or_default().to_lowercase();
            is_among(&last, HEIGHTS)
        }
        "1" | "u" | "U" | "g" | "G" | "'" | "''" | "\"" => false,
        word if word.len() == 1 => wanted.contains(&quantity),
        "min" | "MIN" | "Min" | "in" | "IN" | "In" | "as" | "ref" | "fr" | "data" | "inc"
        | "ang" | "wl" | "sample" | "cycles" => wanted.contains(&quantity),
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(text: &str, exponent: i32) -> f64 {
        Unit::read(text, &[]).unwrap_or_else(|| panic!("{text}")).size(exponent)
    }

    #[test]
    fn sizes_are_exact_to_the_last_bit() {
        // By the definitions: the inch is 25.4 mm, the foot 12 inches; decimal prefixes.
        for (words, nm) in [
            ("m Meter METRES mètre M", 1e9),
            ("mm MM Millimeter millimetres Millimètres", 1e6),
            ("um µm μm UM micron Microns MICRONS Mikrometer micromètre µ", 1e3),
            ("nm NM Nanometer nanomètres Nm", 1.0),
            ("A Å \u{212b} Angstrom angstroms ANGSTROM Ångström A\u{30a}", 0.1),
            ("pm", 1e-3),
            ("kÅ kA", 100.0),
            ("cm Zentimeter", 1e7),
            ("km", 1e12),
            ("in IN inch Inches \" Zoll in.", 25.4e6),
            ("mil Mil mils thou MIL", 25.4e3),
            ("uin µin microinch", 25.4),
            ("ft feet", 304.8e6),
        ] {
            for word in words.split(' ') {
                assert_eq!(size(word, -9), nm, "{word}");
            }
        }
        assert_eq!((size("um", -3), size("in", -3), size("nm", -3)), (1e-3, 25.4, 1e-6));
        for (words, s) in [
            ("s sec Seconds Sekunden", 1.0),
            ("ms msec Millisekunden", 1e-3),
            ("us µs usec", 1e-6),
            ("ns nanoseconds", 1e-9),
            ("min Min MIN minutes Minuten", 60.0),
            ("h hours Std", 3600.0),
            ("d days Tage jours", 86400.0),
        ] {
            for word in words.split(' ') {
                let unit = Unit::read(word, &[Quantity::Time]).unwrap_or_else(|| panic!("{word}"));
                assert_eq!((unit.quantity(), unit.size(0)), (Quantity::Time, s), "{word}");
            }
        }
        let arcsec = std::f64::consts::PI / 648_000.0;
        for (word, rad) in [
            ("urad", 1e-6),
            ("µrad", 1e-6),
            ("arcsec", arcsec),
            ("\"", arcsec),
            ("deg", 60.0 * 60.0 * arcsec),
            ("mrad", 1e-3),
        ] {
            let unit = Unit::read(word, &[Quantity::Angle]).unwrap();
            // Two roundings of a quotient.
            assert!((unit.size(0) / rad - 1.0).abs() < 1e-15, "{word}");
            assert_eq!(unit.quantity(), Quantity::Angle);
        }
    }

    #[test]
    fn rates_and_accelerations() {
        for (words, quantity, exponent, right) in [
            (
                "nm/s|nm / sec|nm per second|nm_per_s|nm s-1|nm s^-1|nm·s⁻¹|nm pro Sekunde",
                Quantity::LengthPerTime,
                -9,
                1.0,
            ),
            (
                "nm/min|nm per minute|nm_per_min|nanometers per minute|nm/Min.|nm par minute",
                Quantity::LengthPerTime,
                -9,
                1.0 / 60.0,
            ),
            ("um/h|µm/hr|microns per hour", Quantity::LengthPerTime, -9, 1.0 / 3.6),
            ("A/s|Å/s|Angstrom/sec", Quantity::LengthPerTime, -9, 0.1),
            ("mm/s|mm/sec|MM/S", Quantity::LengthPerTime, -3, 1.0),
            ("in/min|inch per minute", Quantity::LengthPerTime, -3, 25.4 / 60.0),
            (
                "mm/s2|mm/s^2|mm/s²|mm/s/s|mm/(s^2)|mm s^-2|mm per second squared|mm_per_s2",
                Quantity::Acceleration,
                -3,
                1.0,
            ),
            ("g", Quantity::Acceleration, -3, 9806.65),
            ("deg/s", Quantity::AnglePerTime, 0, std::f64::consts::PI / 180.0),
            ("per minute|1/min|/min", Quantity::PerTime, 0, 1.0 / 60.0),
        ] {
            for text in words.split('|') {
                let unit = Unit::read(text, &[]).unwrap_or_else(|| panic!("{text}"));
                assert_eq!(unit.quantity(), quantity, "{text}");
                // A quotient is rounded once.
                assert!((unit.size(exponent) / right - 1.0).abs() < 1e-15, "{text}");
            }
        }
        let unit = Unit::read("nm per Minute", &[]).unwrap();
        assert_eq!(
            (unit.to_string(), unit.per_s(), unit.numerator().to_string()),
            ("nm/min".into(), Some(60.0), "nm".into())
        );
    }

    #[test]
    fn other_words_are_no_units() {
        for text in [
            "Mm", "Ms", "Mrad", "grad", "furlong", "a", "nm2", "mm^2", "nm/mm", "actual", "",
            "mm/px", "V", "nm/s3", "D", "mm-1",
        ] {
            assert_eq!(Unit::read(text, &[]), None, "{text}");
        }
    }

    #[test]
    fn names_of_columns() {
        use Quantity::{Length, LengthPerTime, Time};
        let read = |text: &str, wanted: &[Quantity]| {
            let header = Header::read(text, wanted).unwrap_or_else(|e| panic!("{e:?}"));
            (header.name, header.unit.map(|unit| unit.to_string()).unwrap_or_default())
        };
        for (text, name, unit) in [
            ("x (mm)", "x", "mm"),
            ("z[um]", "z", "um"),
            ("height_nm", "height", "nm"),
            ("Thickness(A)", "Thickness", "angstrom"),
            ("Thickness_A", "Thickness", "angstrom"),
            ("pos_A", "pos_A", ""),
            ("Höhe / nm", "Höhe", "nm"),
            ("Höhe in µm", "Höhe", "um"),
            ("z/mil", "z", "mil"),
            ("\"z (wv)\"", "z", "waves"),
            ("X Position Feedback (mm)", "X Position Feedback", "mm"),
            ("x position(m)", "x position", "m"),
            ("Position [mm] X", "Position X", "mm"),
            ("X {in}", "X", "in"),
            ("x_in", "x", "in"),
            ("x_min", "x_min", ""),
            ("x_actual", "x_actual", ""),
            ("x (actual)", "x (actual)", ""),
            ("x (1)", "x (1)", ""),
            ("x mm", "x", "mm"),
            ("x", "x", ""),
            ("x [mm] (raw)", "x  (raw)", "mm"),
        ] {
            let (found, found_unit) = read(text, &[Length]);
            let name: Vec<&str> = name.split_whitespace().collect();
            assert_eq!(
                (found.split_whitespace().collect::<Vec<_>>(), found_unit.as_str()),
                (name, unit),
                "{text}"
            );
        }
        for (text, name, unit) in [
            ("time_min", "time", "min"),
            ("time (ns)", "time", "ns"),
            ("t_s", "t", "s"),
            ("SampleTime[ms]", "SampleTime", "ms"),
            ("time (days)", "time", "d"),
            ("time_in_ms", "time", "ms"),
            ("Zeit / min", "Zeit", "min"),
        ] {
            assert_eq!(read(text, &[Time]), (name.into(), unit.into()), "{text}");
        }
        for (text, unit) in [
            ("rate_nm_per_min", "nm/min"),
            ("rate [nm/s]", "nm/s"),
            ("vx_mm_per_s", "mm/s"),
            ("rate nm/min", "nm/min"),
        ] {
            assert_eq!(read(text, &[LengthPerTime]).1, unit, "{text}");
        }
        for (text, word) in [
            ("z (furlong)", "furlong"),
            ("z [Mm]", "Mm"),
            ("z/furlong", "furlong"),
            ("z in furlong", "furlong"),
        ] {
            let unknown = Header::read(text, &[Length]).unwrap_err();
            assert_eq!((unknown.text.as_str(), unknown.word.as_str()), (text, word));
            let refusal = unknown.refused("unit", "give `unit`").to_string();
            assert!(refusal.contains(&format!("\"{word}\" in \"{text}\"")), "{refusal}");
        }
    }
}
