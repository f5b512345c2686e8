//! Statements that a file makes beside its numbers: comments, lines of text, attributes, variables and header cards.
//!
//! A statement is a key and a value, such as `# Value units: nm`, `"XY Calibration","500","um"` or `pixel_mm = 0.5`, or names
//! with their units, such as `# x[mm] y[mm] z[um]` or `# mm mm nm`. [`Beside`] reads it, or keeps it for a warning. A
//! statement of a unit that nobody understands is refused.
//!
//! Keys are known in English, German, French, Spanish, Italian, Czech, Russian, Chinese and Japanese, as Gwyddion writes
//! them. The header of Gwyddion's text export is also known by its form: two sizes with their units, one below the other.

use planish_types::Invalid;

use crate::{
    Format,
    reading::{FirstRow, Reading},
    text,
    unit::Unit,
};

/// Largest number of unused statements that a warning quotes. Larger: long warnings. Smaller: more statements are not
/// named.
const MOST_QUOTED: usize = 5;

/// Longest part of a comment that is read, characters; the rest is ignored. Larger: more memory for a hostile file.
/// Smaller: long statements are cut.
const LONGEST: usize = 1000;

/// Keys that state the unit of the heights or rates, in lower case. `|` separates them, as in all lists below.
const UNITS: &str = "\
    unit|units|value unit|value units|z unit|z units|zunit|zunits|unit z|units z|unit of z|\
    units of z|height unit|height units|data unit|data units|rate unit|rate units|removal unit|\
    depth unit|einheit|einheiten|werteinheit|werteinheiten|einheit der werte|einheiten der werte|\
    höheneinheit|z einheit|unité|unités|unité z|unités z|unité de valeur|unités de valeur|\
    unités des valeurs|unidad|unidades|unidad z|unidades z|unidades de valor|unidades del valor|\
    unidades de los valores|unità|unità z|unità del valore|unità dei valori|unità di misura|\
    jednotky hodnot|единицы значений|единицы|单位|值单位|数值单位|值的单位|z单位|z 单位|高度单位|単位|値の単位|高さ単位|高さの単位|z単位|\
    z 単位";

/// Keys that state the unit of both coordinates, x and y.
const COORDINATE_UNITS: &str = "\
    coordinate unit|coordinate units|coordinates unit|lateral unit|lateral units|xy unit|xy units|\
    xyunits|xyunit|x unit|y unit|x units|y units|xunit|yunit|xunits|yunits|axis unit|axis units|\
    position unit|position units|xy einheit|x einheit|y einheit";

/// Keys that state the size of the map along x.
const WIDTHS: &str = "\
    width|breite|largeur|ancho|anchura|larghezza|largura|šířka|ширина|宽度|宽|寬度|幅|x size|size x|xreal";

/// Keys that state the size of the map along y.
const HEIGHTS: &str = "\
    height|höhe|hoehe|hauteur|alto|altura|altezza|výška|высота|高度|高|高さ|y size|size y|yreal";

/// Keys that state the distance of neighbouring pixels.
const PITCHES: &str = "\
    pixel size|pixelsize|pixel pitch|pixel spacing|pixel|pixels|pitch|lateral resolution|\
    lateral res|sampling|spacing|xy calibration|calibration|d|step|pix|pixsize|pixelsz|pixsz|\
    grid spacing|grid step|sample spacing|resolution|increment|pixelgröße|pixelgrösse|pixelabstand|\
    pixelweite|auflösung|taille de pixel|taille du pixel|taille des pixels|pas|pas de pixel|\
    tamaño de píxel|tamaño del píxel|tamaño de pixel|paso|dimensione pixel|dimensione del pixel|\
    passo|xy kalibrierung|kalibrierung|étalonnage xy|calibración xy|calibrazione xy|校正值|校正|校正値|\
    xyキャリブレーション|キャリブレーション|像素尺寸|像素大小|像素间距|画素サイズ|ピクセルサイズ|画素ピッチ";

/// Keys that state the wavelength of the light.
const WAVELENGTHS: &str = "\
    wavelength|wave length|lambda|wavelen|wavelnth|wl|λ|wellenlänge|longueur d'onde|\
    longitud de onda|lunghezza d'onda|длина волны|波长|波長";

/// Keys that state which side of the map (top or bottom) the first row of the file is.
const ROWS: &str = "\
    first row|first line|row order|rows|origin|erste zeile|première ligne|primera fila|prima riga";

/// Keys whose value lists the names of the columns, which may have their units.
const COLUMNS: &str = "columns|column|fields|data|format|spalten|colonnes|columnas|colonne";

/// Keys that state the number of columns (first list), and the number of rows (second list).
const COUNTS: [&str; 2] = [
    "horizontal|x pixels|xpixels|nx|xres|ncols|columns|spalten",
    "vertical|y pixels|ypixels|ny|yres|nrows|rows|zeilen",
];

/// Parts of keys that could change how values or pixels are read. Unused statements with such a part in their key give
/// a warning.
const TELLING: &str = "\
    unit|pixel|pitch|spacing|resolution|scale|offset|wavelength|missing|einheit|unité|unidad|unità|\
    单位|単位|calibration|sampling";

/// Names under which a column or statement may give the values of a map.
const VALUE_NAMES: &str = "\
    z|h|height|heights|höhe|höhen|hauteur|hauteurs|altura|alturas|altezza|altezze|thickness|dicke|\
    depth|tiefe|sag|figure|error|surface|value|values|werte|rate|rates|removal|opd|film|高さ|高度|map|\
    intensity";

/// Names that stand for both coordinates together.
const COORDINATE_NAMES: &str = "xy|lateral|coordinates|coordinate|koordinaten|coordonnées";

/// A variable or an attribute of a file that also holds a map, as text.
#[derive(Debug)]
pub(crate) struct Variable {
    pub key: String,
    pub value: String,
    /// Place of the variable in the file, for messages, such as "attribute".
    pub place: String,
}

/// Statements of a file that were read so far; `None` for those that it does not make.
#[derive(Debug, Default)]
pub(crate) struct Beside {
    /// Unit of the values of the map; `None` if no statement is understood.
    unit: Option<Unit>,
    /// Unit of the values as the file writes it. If it is no unit, `unit_problem` is the reason to refuse it.
    unit_word: Option<String>,
    unit_problem: Option<Invalid>,
    /// Unit that the file states without saying whether it is that of the values or of the coordinates.
    pub lone_unit: Option<Unit>,
    /// Unit of both coordinates.
    pub coordinate_unit: Option<Unit>,
    /// Sizes of the map along [x, y], mm.
    size_mm: [Option<f64>; 2],
    /// Pitch along [x, y], mm.
    pitch_mm: [Option<f64>; 2],
    /// Sizes of the map along [x, y] as SPIP writes them, in the units `length_unit`, which are separate statements.
    length: [Option<f64>; 2],
    length_unit: [Option<Unit>; 2],
    nm_per_bit: Option<f64>,
    wavelength_nm: Option<f64>,
    first_row: Option<FirstRow>,
    /// Stated numbers of columns and rows, in this order.
    counts: [Option<usize>; 2],
    /// Length (mm) under an unknown key, and the place of this statement. Two such lengths at neighbouring places are
    /// the sizes along x and y.
    unknown_size: Option<(f64, usize)>,
    /// Statements that are not used, as a warning quotes them; at most [`MOST_QUOTED`].
    unused: Vec<String>,
}

/// A number at the beginning of a text, and the text after it (`rest`).
struct Quantity<'a> {
    value: f64,
    rest: &'a str,
}

/// Returns the number at the beginning of a text, with a decimal point or comma; `None` without one, or if it is not
/// finite.
fn leading_number(text: &str) -> Option<Quantity<'_>> {
    let text = text.trim();
    let end = text
        .char_indices()
        .find(|(i, c)| {
            let is_exponent = matches!(c, 'e' | 'E')
                && *i > 0
                && text[i + 1..].starts_with(|n: char| n.is_ascii_digit() || n == '-' || n == '+');
            !("+-.,0123456789".contains(*c) || is_exponent)
        })
        .map_or(text.len(), |(i, _)| i);
    let number = text[..end].trim_end_matches(',');
    let number = if number.contains('.') { number.into() } else { number.replacen(',', ".", 1) };
    let value = number.parse::<f64>().ok().filter(|v| v.is_finite())?;
    Some(Quantity { value, rest: text[end..].trim() })
}

/// Returns a key in lower case. Hyphens, points, underscores, tabs, quotation marks and runs of blanks become single
/// blanks.
fn plain(key: &str) -> String {
    let marks = ['_', '-', '.', '\u{a0}', '\u{202f}', '\t', '"'];
    key.to_lowercase().replace(marks, " ").split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Splits a statement at its first colon or equals sign into key and value, without blanks and quotation marks; `None`
/// without such a sign.
pub(crate) fn key_and_value(text: &str) -> Option<(&str, &str)> {
    let (key, value) = text.split_once([':', '=', '：'])?;
    Some((key.trim(), value.trim().trim_matches(['"', '\''])))
}

impl Beside {
    /// Reads a comment without the sign that begins it; `line` is its number in the file, counted from 1. A comment
    /// that may change how the file is read, and is not understood, is kept for the warning.
    ///
    /// # Errors
    /// Refuses a unit that is not understood, and a statement that contradicts another one.
    pub fn add_comment(&mut self, comment: &str, line: usize) -> Result<(), Invalid> {
        let end = comment.char_indices().nth(LONGEST).map_or(comment.len(), |(end, _)| end);
        let comment = &comment[..end];
        let place = format!("line {line}");
        if let Some(nm) = wavelength_in(comment) {
            self.wavelength_nm = Some(nm);
        }
        let Some((key, value)) = key_and_value(comment) else {
            // Such as "pixel size 0.5 mm".
            let number = comment.find(|c: char| c.is_ascii_digit()).unwrap_or(0);
            let (key, value) = comment.split_at(number);
            if !key.trim().is_empty() && self.add(key.trim(), value, None, line)? {
                return Ok(());
            }
            if self.add_columns(comment)? {
                return Ok(());
            }
            if let Some(unit) = unit_after_in(comment) {
                self.lone_unit = self.lone_unit.or(Some(unit));
            } else if names_a_unit(comment) || claims_a_unit(comment) {
                self.leave(comment, &place);
            }
            return Ok(());
        };
        let is_list = is_key(COLUMNS, &plain(key))
            || (is_key(UNITS, &plain(key)) && Unit::spelled(value).is_none());
        if is_list && self.add_columns(value)? {
            return Ok(());
        }
        if self.add(key, value, None, line)? {
            return Ok(());
        }
        let columns = units_of_columns(comment)?;
        let named = columns.iter().filter(|unit| unit.is_some()).count();
        if named >= 2 || (named == 1 && Unit::spelled(value).is_some()) {
            return self.take_columns(columns);
        }
        if is_telling(key) || is_length(value) {
            self.leave(comment, &place);
        }
        Ok(())
    }

    /// Reads a line of text above the numbers, which is split into `fields`: key, value, and perhaps a unit. `line` is
    /// its number in the file, counted from 1.
    ///
    /// # Errors
    /// As [`Self::add_comment`].
    pub fn add_fields(&mut self, fields: &[&str], line: usize) -> Result<(), Invalid> {
        let [key, value, more @ ..] = fields else {
            return self.add_comment(fields.first().copied().unwrap_or_default(), line);
        };
        let key = key.trim_end_matches([':', '=', '：']).trim();
        let unit = more.first().copied().filter(|unit| !unit.is_empty());
        if self.add(key, value, unit, line)? {
            return Ok(());
        }
        let all = fields.join(", ");
        if !self.add_columns(&all)? && (is_telling(key) || names_a_unit(&all)) {
            self.leave(&all, &format!("line {line}"));
        }
        Ok(())
    }

    /// Reads a statement, and returns true if it is used. Its unit may stand at the end of `key`, in `value` or in
    /// `unit`. `place` is the number of the line, or the number of the statement; statements are neighbours if their
    /// places differ by 1.
    ///
    /// # Errors
    /// As [`Self::add_comment`].
    pub fn add(
        &mut self,
        key: &str,
        value: &str,
        unit: Option<&str>,
        place: usize,
    ) -> Result<bool, Invalid> {
        let whole = plain(key);
        if is_key(UNITS, &whole) {
            self.unit_word = Some(value.to_string());
            match Unit::stated("unit", value) {
                Ok(unit) => self.state_unit(unit)?,
                Err(problem) => self.unit_problem = Some(problem),
            }
            return Ok(true);
        }
        if is_key(COORDINATE_UNITS, &whole) {
            let stated = Unit::stated("coordinate_unit", value)?;
            // SPIP's unit of one length; the unit of both where no length is stated.
            self.length_unit[usize::from(whole.starts_with('y'))] = Some(stated);
            if self.length == [None; 2] {
                self.coordinate_unit = Some(stated);
            }
            return Ok(true);
        }
        match whole.as_str() {
            "x length" | "y length" => {
                let number = text::number("CSV file", value, place, 2)?;
                self.length[usize::from(whole.starts_with('y'))] = Some(number);
                return Ok(true);
            }
            "bit2nm" => {
                self.nm_per_bit = Some(text::number("CSV file", value, place, 2)?);
                return Ok(true);
            }
            _ => {}
        }
        if is_key(ROWS, &whole)
            && let Some(row) = row_of(value)
        {
            self.first_row = Some(row);
            return Ok(true);
        }
        match leading_number(value) {
            Some(number) => self.add_number(key, number, unit, place),
            None => Ok(false),
        }
    }

    /// Reads a statement whose value begins with a number; arguments, result and what is refused are those of
    /// [`Self::add`].
    fn add_number(
        &mut self,
        key: &str,
        Quantity { value: number, rest }: Quantity,
        unit: Option<&str>,
        place: usize,
    ) -> Result<bool, Invalid> {
        let whole = plain(key);
        for (count, keys) in self.counts.iter_mut().zip(COUNTS) {
            if is_key(keys, &whole) && rest.is_empty() && number >= 1.0 && number.fract() == 0.0 {
                *count = Some(number as usize);
                return Ok(true);
            }
        }
        let (name, of_key) = Unit::of_name(key).unwrap_or_else(|_| (key.into(), None));
        let name = plain(&name);
        // Such as "0.5 mm x 0.25 mm".
        let marks = ['x', 'X', '×', ',', ';', '*'];
        let (word, second) = match rest.split_once(marks) {
            Some((word, second)) => (word.trim(), leading_number(second)),
            None => (rest, None),
        };
        let of_value = [unit.unwrap_or_default(), word, second.as_ref().map_or("", |q| q.rest)]
            .into_iter()
            .find_map(Unit::spelled);
        let unit = of_value.or(of_key).filter(|unit| unit.mm().is_ok());
        if is_key(WAVELENGTHS, &name) {
            let nm = match unit {
                Some(unit) => number * unit.nm(None)?,
                None => wavelength_nm(number).unwrap_or(f64::NAN),
            };
            self.wavelength_nm = Some(nm).filter(|nm| nm.is_finite() && *nm > 0.0);
            return Ok(self.wavelength_nm.is_some());
        }
        let Some(unit) = unit else { return Ok(false) };
        let mm = number * unit.mm()?;
        for (size, keys) in self.size_mm.iter_mut().zip([WIDTHS, HEIGHTS]) {
            if is_key(keys, &name) {
                *size = Some(mm);
                return Ok(true);
            }
        }
        if let Some(axes) = axes_of_pitch(&name) {
            let along_y = second.map_or(mm, |q| q.value * unit.mm().unwrap_or(f64::NAN));
            for (k, value) in [mm, along_y].into_iter().enumerate() {
                if axes[k] {
                    self.pitch_mm[k] = Some(value);
                }
            }
            return Ok(true);
        }
        // The sizes of Gwyddion's export in a language that the tables do not have.
        match self.unknown_size.take() {
            Some((width, before)) if before + 1 == place && self.size_mm == [None; 2] => {
                self.size_mm = [Some(width), Some(mm)];
                Ok(true)
            }
            _ => {
                self.unknown_size = Some((mm, place));
                Ok(false)
            }
        }
    }

    /// Reads variables or attributes. One whose name is that of another with `unit` or `units` after it states the unit
    /// of the other, such as `pixel_size_unit` for `pixel_size`.
    ///
    /// # Errors
    /// As [`Self::add_comment`].
    pub fn add_variables(&mut self, variables: &[Variable]) -> Result<(), Invalid> {
        let plain_keys: Vec<String> = variables.iter().map(|v| plain(&v.key)).collect();
        let companions = plain_keys.iter().map(|key| {
            let names = [format!("{key} unit"), format!("{key} units")];
            plain_keys.iter().position(|other| names.contains(other))
        });
        let companions: Vec<Option<usize>> = companions.collect();
        for (i, variable) in variables.iter().enumerate() {
            if companions.contains(&Some(i)) {
                continue;
            }
            let unit = companions[i].map(|k| variables[k].value.as_str());
            // Variables have no order: no two are neighbours.
            let is_used = self.add(&variable.key, &variable.value, unit, 2 * i)?;
            if !is_used && is_telling(&variable.key) {
                let short: String = variable.value.chars().take(30).collect();
                self.leave(&format!("{} = {short}", variable.key), &variable.place);
            }
        }
        Ok(())
    }

    /// Reads a text that names columns with their units, such as `x[mm] y[mm] z[um]`, `mm mm nm` or `x, y in mm, z in
    /// nm`. Returns false if the text states no unit. Refuses an unknown unit, and what [`Self::take_columns`] refuses.
    fn add_columns(&mut self, text: &str) -> Result<bool, Invalid> {
        let units = units_of_columns(text)?;
        if units == [None; 3] {
            return Ok(false);
        }
        self.take_columns(units)?;
        Ok(true)
    }

    /// Records the units of the columns x, y and z; `None` leaves one open. Refuses different units of x and y, and
    /// units that contradict earlier ones.
    fn take_columns(&mut self, [x, y, z]: [Option<Unit>; 3]) -> Result<(), Invalid> {
        if let (Some(x), Some(y)) = (x, y)
            && x != y
        {
            let problem = format!("is {x} of x and {y} of y");
            let remedy = "give both coordinates the same unit";
            return Err(Invalid::whole("coordinate_unit", problem, remedy));
        }
        if let Some(unit) = x.or(y) {
            if let Some(before) = self.coordinate_unit.filter(|before| *before != unit) {
                let problem = format!("is {before} and {unit} in the comments");
                return Err(Invalid::whole("coordinate_unit", problem, "correct the comments"));
            }
            self.coordinate_unit = Some(unit);
        }
        z.map_or(Ok(()), |unit| self.state_unit(unit))
    }

    /// Records the unit of the values.
    ///
    /// # Errors
    /// Refuses a unit that differs from an earlier statement.
    pub fn state_unit(&mut self, unit: Unit) -> Result<(), Invalid> {
        if let Some(before) = self.unit.filter(|before| *before != unit) {
            let problem = format!("is {before} in one statement of the file, {unit} in another");
            return Err(Invalid::whole("unit", problem, "correct the one that is wrong"));
        }
        self.unit = Some(unit);
        Ok(())
    }

    /// Keeps a statement that is not used, for the warning. `place` says where in the file it stands.
    pub fn leave(&mut self, statement: &str, place: &str) {
        if self.unused.len() < MOST_QUOTED {
            let short = statement.trim().chars().filter(|c| !c.is_control()).take(60);
            self.unused.push(format!("\"{}\" ({place})", short.collect::<String>()));
        }
    }

    /// Completes `reading` with these statements: each fills in what the format itself does not state. A stated first
    /// row and `Bit2nm` replace what `reading` has. A unit that differs from that of the file becomes `unit_problem`,
    /// and wrong numbers of rows or columns give a warning.
    ///
    /// # Errors
    /// Refuses `Bit2nm` other than 1 beside a unit other than nm, and a size in a unit that is no length.
    pub fn apply(self, reading: &mut Reading) -> Result<(), Invalid> {
        let (rows, columns) = reading.values.dim();
        if let Some(unit) = self.unit {
            if let Some(own) = reading.unit.filter(|own| *own != unit && !reading.unit_by_custom) {
                let problem =
                    format!("is {own} in the file, {unit} in a statement beside the numbers");
                let remedy = "correct the one that is wrong, or give `unit` and `override_file`";
                reading.unit_problem = Some(Invalid::whole("unit", problem, remedy));
            } else {
                reading.unit = Some(unit);
                reading.unit_by_custom = false;
            }
        }
        if reading.unit.is_none() && reading.unit_word.is_none() {
            reading.unit_problem = reading.unit_problem.take().or(self.unit_problem);
            reading.unit_word = self.unit_word;
        }
        reading.lone_unit = reading.lone_unit.or(self.lone_unit);
        if let Some(nm) = self.nm_per_bit {
            // SPIP writes one or the other; both together could mean two things.
            let in_nm = Unit::named("nm");
            if nm != 1.0 && self.unit.is_some_and(|unit| unit != in_nm) {
                let problem = format!("states Bit2nm = {nm} and z-unit {:?}", self.unit);
                return Err(Invalid::whole("CSV file", problem, "delete the one that is wrong"));
            }
            reading.unit = self.unit.or(Some(in_nm));
            reading.factor = nm;
        }
        let mut size_mm = self.size_mm;
        for k in 0..2 {
            if let (None, Some(length)) = (size_mm[k], self.length[k]) {
                size_mm[k] = Some(length * self.length_unit[k].unwrap_or(Unit::named("nm")).mm()?);
            }
        }
        if let Some(coordinates) = &mut reading.coordinates {
            coordinates.unit = coordinates.unit.or(self.coordinate_unit);
        } else if reading.rule.is_none() && reading.pixel_mm.is_none() {
            let [x, y] = [(0, columns), (1, rows)]
                .map(|(k, count)| size_mm[k].map(|mm| mm / count as f64).or(self.pitch_mm[k]));
            if let (Some(x), Some(y)) = (x, y) {
                reading.pixel_mm = Some([x, y]);
                // Programs that write the size into a text write the picture from its top.
                if reading.format == Format::Csv && size_mm.iter().all(Option::is_some) {
                    reading.first_row = FirstRow::Top;
                }
            }
        }
        if let Some(row) = self.first_row {
            reading.first_row = row;
            reading.first_row_stated = true;
        }
        reading.wavelength_nm = reading.wavelength_nm.or(self.wavelength_nm);
        for (k, (stated, count)) in self.counts.into_iter().zip([columns, rows]).enumerate() {
            if let Some(stated) = stated.filter(|stated| *stated != count) {
                let what = ["columns", "rows"][k];
                reading.warnings.push(format!(
                    "the file states {stated} {what}, and has {count}: is it truncated, or cropped?"
                ));
            }
        }
        if !self.unused.is_empty() {
            let say = format!("statements that are not used: {}", self.unused.join(", "));
            reading.warnings.push(say);
        }
        Ok(())
    }
}

/// Returns true if `key` is one of the words in the list `keys`, whose separator is `|`.
fn is_key(keys: &str, key: &str) -> bool {
    keys.split('|').any(|word| word == key)
}

/// Returns true if the text begins with a number, and the word after it is a unit of a map.
fn is_length(value: &str) -> bool {
    let word = leading_number(value).and_then(|number| number.rest.split_whitespace().next());
    word.is_some_and(|word| Unit::spelled(word).is_some())
}

/// Returns true if a key could change how values or pixels are read, such as one with the word `scale`.
pub(crate) fn is_telling(key: &str) -> bool {
    let key = plain(key);
    TELLING.split('|').any(|word| key.contains(word))
}

/// Returns for which of the axes [x, y] a key states the pitch, such as `pixel size`, `x pixel size`, `dx` or `pixel
/// y`. Returns `None` for another key.
fn axes_of_pitch(name: &str) -> Option<[bool; 2]> {
    if is_key(PITCHES, name) && name != "d" {
        return Some([true; 2]);
    }
    for (letter, axes) in [("x", [true, false]), ("y", [false, true])] {
        let shorter = [
            name.strip_prefix(&format!("{letter} ")),
            name.strip_suffix(&format!(" {letter}")),
            name.strip_prefix(letter),
            name.strip_suffix(letter),
        ];
        if shorter.into_iter().flatten().any(|rest| is_key(PITCHES, rest.trim())) {
            return Some(axes);
        }
    }
    None
}

/// Returns the side of the map that the first row is, from words such as `top` or `unten`; `None` without such a word,
/// or with words for both sides.
fn row_of(value: &str) -> Option<FirstRow> {
    let value = value.to_lowercase();
    let [top, bottom] = [
        ["top", "upper", "oben", "haut", "superior", "arriba", "largest y", "descending"],
        ["bottom", "lower", "unten", "bas", "inferior", "abajo", "smallest y", "ascending"],
    ]
    .map(|words| words.iter().any(|word| value.contains(word)));
    match (top, bottom) {
        (true, false) => Some(FirstRow::Top),
        (false, true) => Some(FirstRow::SmallestY),
        _ => None,
    }
}

/// Returns the wavelength of the light, nm, after the sign `@` in a text such as `z [waves @ 632.8 nm]`; `None` without
/// one.
fn wavelength_in(text: &str) -> Option<f64> {
    let (_, after) = text.split_once('@')?;
    let Quantity { value, rest } = leading_number(after)?;
    let word: String = rest.chars().take_while(|c| c.is_alphabetic() || *c == 'µ').collect();
    match Unit::spelled(&word) {
        Some(unit) => Some(value * unit.mm().ok()? * 1e6),
        None => wavelength_nm(value),
    }
}

/// Returns the unit after a word such as `in` or `unit` in a sentence such as `all lengths in mm`; `None` without one.
/// Of the units of one letter only `m` counts.
fn unit_after_in(text: &str) -> Option<Unit> {
    let words: Vec<&str> =
        text.split_whitespace().map(|w| w.trim_matches([',', ';', '.', ')', '('])).collect();
    let pairs = words
        .windows(2)
        .filter(|pair| matches!(pair[0], "in" | "en" | "unit" | "units" | "Units" | "Unit"));
    pairs
        .filter(|pair| pair[1] == "m" || pair[1].chars().count() > 1)
        .find_map(|pair| Unit::spelled(pair[1]))
}

/// Returns true for a sentence that names a column x, y or z and has the word "in", "unit" or "units", such as `heights
/// in furlong`. It does not check that the unit is known.
fn claims_a_unit(text: &str) -> bool {
    let words: Vec<String> = text.split_whitespace().map(plain).collect();
    let names = words.iter().any(|word| axes_of_name(word) != [false; 3]);
    names && words.iter().any(|word| matches!(word.as_str(), "in" | "unit" | "units"))
}

/// Returns a wavelength that was stated without a unit, in nm. It is read as nm, um or m, the first of these for which
/// it lies between 100 nm and 20 um; `None` if it does for none.
fn wavelength_nm(value: f64) -> Option<f64> {
    [1.0, 1e3, 1e9].into_iter().map(|nm| value * nm).find(|nm| (100.0..20_000.0).contains(nm))
}

/// A part of a line that names columns: a word, the text in brackets, or a number.
#[derive(Debug, PartialEq)]
enum HeaderWord<'a> {
    Word(&'a str),
    Bracket(&'a str),
    Number,
}

/// Splits a text into its words, numbers and texts in brackets.
fn header_words(text: &str) -> Vec<HeaderWord<'_>> {
    let mut words = Vec::new();
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let closing = match c {
            '(' => Some(')'),
            '[' => Some(']'),
            '{' => Some('}'),
            _ => None,
        };
        if let Some((inside, after)) = closing.and_then(|close| rest[1..].split_once(close)) {
            words.push(HeaderWord::Bracket(inside.trim()));
            rest = after;
            continue;
        }
        let end = rest.find(|c: char| c.is_whitespace() || "()[]{},;:=|\"：".contains(c));
        let end = end.unwrap_or(rest.len());
        if end == 0 {
            rest = &rest[c.len_utf8()..];
            continue;
        }
        let word = &rest[..end];
        words.push(if word.parse::<f64>().is_ok() {
            HeaderWord::Number
        } else {
            HeaderWord::Word(word)
        });
        rest = &rest[end..];
    }
    words
}

/// Returns true for each of the columns [x, y, z] that a word names; a word such as `xy` names two.
fn axes_of_name(word: &str) -> [bool; 3] {
    let word = plain(word);
    if is_key(COORDINATE_NAMES, &word) {
        return [true, true, false];
    }
    let first = word.split(' ').next();
    [first == Some("x"), first == Some("y"), is_key(VALUE_NAMES, &word)]
}

/// Returns the units that a text gives to the columns [x, y, z]; `None` for a column without one. Two units alone are
/// those of x and y, and of z; three are those of x, y and z.
///
/// # Errors
/// Refuses a word in brackets after the name of a column that is no unit.
fn units_of_columns(text: &str) -> Result<[Option<Unit>; 3], Invalid> {
    let header_words = header_words(text);
    let mut units = [None; 3];
    let words: Vec<Option<Unit>> = header_words
        .iter()
        .map(|piece| match piece {
            HeaderWord::Word(word) | HeaderWord::Bracket(word) => Unit::spelled(word),
            HeaderWord::Number => None,
        })
        .collect();
    if let [Some(x), Some(y), Some(z)] = words[..] {
        return Ok([Some(x), Some(y), Some(z)]);
    }
    if let [Some(xy), Some(z)] = words[..] {
        return Ok([Some(xy), Some(xy), Some(z)]);
    }
    let mut named = [false; 3];
    let mut after_number = false;
    let mut after_in = false;
    for piece in &header_words {
        let unit = match piece {
            HeaderWord::Number => {
                after_number = true;
                after_in = false;
                continue;
            }
            HeaderWord::Word(word) => {
                let (name, of_name) = if word.contains(['_', '/']) {
                    Unit::of_name(word).unwrap_or_else(|_| ((*word).into(), None))
                } else {
                    ((*word).into(), None)
                };
                let axes = axes_of_name(&name);
                if axes != [false; 3] {
                    named = [0, 1, 2].map(|k| named[k] || axes[k]);
                    if of_name.is_none() {
                        after_number = false;
                        after_in = false;
                        continue;
                    }
                    of_name
                } else if !after_in
                    && matches!(*word, "in" | "en" | "unit" | "units" | "Unit" | "Units")
                {
                    after_in = true;
                    continue;
                } else {
                    // A word of one letter, and "min", may be anything.
                    let is_certain =
                        word.chars().count() > 1 && !matches!(*word, "min" | "as" | "in");
                    if after_in || is_certain { Unit::spelled(word) } else { None }
                }
            }
            HeaderWord::Bracket(word) => {
                let word = word.split('@').next().unwrap_or_default().trim();
                let unit = Unit::spelled(word);
                let is_word = word.chars().any(char::is_alphabetic) && !word.contains(' ');
                if unit.is_none() && is_word && named != [false; 3] && word.chars().count() < 12 {
                    // The refusal of the table, unless the bracket is a remark such as (raw).
                    Unit::of_name(&format!("z ({word})"))?;
                }
                unit
            }
        };
        if let Some(unit) = unit.filter(|_| !after_number) {
            for k in 0..3 {
                if named[k] {
                    units[k] = Some(unit);
                }
            }
            named = [false; 3];
        }
        after_number = false;
        after_in = false;
    }
    Ok(units)
}

/// Returns true if a word of the text, or a text in brackets, is a unit. Words of one letter and `in` do not count.
fn names_a_unit(text: &str) -> bool {
    header_words(text).iter().any(|piece| match piece {
        HeaderWord::Word(word) => {
            word.chars().count() > 1 && *word != "in" && Unit::spelled(word).is_some()
        }
        HeaderWord::Bracket(word) => Unit::spelled(word).is_some(),
        HeaderWord::Number => false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    fn columns(text: &str) -> String {
        let name = |unit: Option<Unit>| unit.map(|u| u.to_string()).unwrap_or_else(|| "-".into());
        units_of_columns(text).unwrap().map(name).join(" ")
    }

    #[test]
    fn names_of_columns_have_their_units() {
        for (text, right) in [
            (" x[mm] y[mm] z[um]", "mm mm um"),
            (" mm mm mm", "mm mm mm"),
            ("mm, nm", "mm mm nm"),
            (" x position(m) y position(m) height(m)", "m m m"),
            ("X (mm), Y (mm), Thickness (A)", "mm mm angstrom"),
            ("x_mm y_mm z_nm", "mm mm nm"),
            ("x, y in mm, z in nm", "mm mm nm"),
            ("coordinates in mm, heights in µm", "mm mm um"),
            ("x: mm, y: mm, z: waves", "mm mm waves"),
            ("lateral mm; height nm", "mm mm nm"),
            ("Höhe [µm]", "- - um"),
            ("height map of mirror 7, 500 nm PV", "- - -"),
            ("x (actual) y (actual) z (raw)", "- - -"),
            ("measured in Berlin", "- - -"),
            ("removal rate [nm/min]", "- - nm/min"),
            ("x [mm] y [mm] z [waves @ 632.8 nm]", "mm mm waves"),
            ("all lengths in m", "- - -"),
        ] {
            assert_eq!(columns(text), right, "{text}");
        }
        assert!(units_of_columns("x [mm] y [mm] z [furlong]").is_err());
    }

    fn read(comments: &[&str]) -> Reading {
        let mut beside = Beside::default();
        for (i, comment) in comments.iter().enumerate() {
            beside.add_comment(comment, i + 1).unwrap_or_else(|e| panic!("{comment}: {e}"));
        }
        let values = Array2::zeros((20, 30));
        let mut reading = Reading::new(Format::Csv, values, FirstRow::SmallestY);
        beside.apply(&mut reading).unwrap();
        reading
    }

    #[test]
    fn the_header_of_gwyddion_is_read_in_every_language() {
        for comments in [
            [" Channel: Height", " Width: 15.0 mm", " Height: 10 mm", " Value units: nm"],
            [" Kanal: Höhe", " Breite: 15 mm", " Höhe: 10 mm", " Value units: nm"],
            [" Kanal: Höhe", " Breite: 15,0 mm", " Höhe: 10 mm", " Werteinheiten: nm"],
            [
                " Canal : Hauteur",
                " Largeur\u{a0}: 1,5 cm",
                " Hauteur\u{a0}: 1 cm",
                " Unités de valeur : nm",
            ],
            [" Canal: Altura", " Ancho: 15 mm", " Alto: 10 mm", " Unidades de valor: nm"],
            [" Canale: Altezza", " Larghezza: 15 mm", " Altezza: 10 mm", " Unità del valore: nm"],
            [" 通道：高度", " 宽度：15 mm", " 高度：10 mm", " 值单位：nm"],
            [" チャンネル: 高さ", " 幅: 15 mm", " 高さ: 10 mm", " 値の単位: nm"],
            // A language that the tables do not have: by the form of the header.
            [" Kanava: Korkeus", " Leveys: 15 mm", " Korkeus: 10 mm", " z units: nm"],
        ] {
            let reading = read(&comments);
            // 15 mm over 30 pixels, 10 mm over 20: quotients of a product.
            let [x, y] = reading.pixel_mm.unwrap_or_else(|| panic!("{comments:?}"));
            assert!((x - 0.5).abs() < 1e-12 && (y - 0.5).abs() < 1e-12, "{comments:?}");
            assert_eq!((reading.first_row, reading.unit), (FirstRow::Top, Some(Unit::named("nm"))));
        }
    }

    #[test]
    fn pitches_and_wavelengths_are_read_in_their_words() {
        for (comment, right) in [
            (" pixel size: 0.5 mm", Some([0.5, 0.5])),
            (" pitch (um) = 500", Some([0.5, 0.5])),
            ("pixel_mm = 0.5", Some([0.5, 0.5])),
            ("Pixelgröße: 0,5 mm", Some([0.5, 0.5])),
            ("pixel size = 0.5 mm x 0.25 mm", Some([0.5, 0.25])),
            ("pixel size (mm): 0.5 x 0.25", Some([0.5, 0.25])),
            ("pixel size: 0.02 in", Some([0.508, 0.508])),
            ("XY Calibration: 500 um", Some([0.5, 0.5])),
            ("pixel size 0.5 mm", Some([0.5, 0.5])),
            ("pixel size: 0.5", None),
            ("camera: 7 mm away", None),
        ] {
            let found = read(&[comment]).pixel_mm;
            let same = match (found, right) {
                (Some(a), Some(b)) => (0..2).all(|k| (a[k] - b[k]).abs() < 1e-12),
                (None, None) => true,
                _ => false,
            };
            assert!(same, "{comment}: {found:?}");
        }
        assert_eq!(read(&["dx_mm = 0.5", "dy_mm: 0.25"]).pixel_mm, Some([0.5, 0.25]));
        for text in [
            "wavelength: 632.8 nm",
            "Wellenlänge = 0.6328 µm",
            "lambda: 632.8",
            "wavelength = 6.328e-7",
        ] {
            let nm = read(&[text]).wavelength_nm.unwrap_or_else(|| panic!("{text}"));
            // A product of two roundings.
            assert!((nm / 632.8 - 1.0).abs() < 1e-14, "{text}: {nm}");
        }
        let nm = read(&["z [waves @ 632.8 nm]"]).wavelength_nm.unwrap();
        // From nm to mm and back: two roundings.
        assert!((nm / 632.8 - 1.0).abs() < 1e-14, "{nm}");
        assert_eq!(read(&["all lengths in m"]).lone_unit, Some(Unit::named("m")));
        assert_eq!(read(&["rate: nm/h"]).unit, Some(Unit::named("nm/h")));
        assert!(read(&["heights are in furlong"]).warnings[0].contains("furlong"));
        assert_eq!(read(&["first row: top"]).first_row, FirstRow::Top);
        assert!(read(&["camera: 7 mm away"]).warnings[0].contains("camera: 7 mm away"));
    }
}
