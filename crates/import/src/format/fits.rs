//! FITS images: blocks of 2880 bytes, cards of 80 characters, big-endian numbers.
//!
//! ```text
//! value        = BZERO + BSCALE raw
//! coordinate n = CRVALn + CDn_n (i - CRPIXn),   i = 1 ... NAXISn,   CDn_n = CDELTn PCn_n
//! ```
//!
//! BLANK or NaN is an invalid pixel; so is one at which an image extension called MASK is not 0, as CCDData of
//! astropy writes it. A file with any other second image is refused until `dataset` or `mask` names one. The unit is BUNIT, that of the coordinates CUNITn. A header without CRPIX and CRVAL
//! has a pitch alone, |CDELTn|. The first row of the file is the smallest y, as the standard shows it; an axis with a
//! negative step runs the other way. Axes that are turned, sheared or not linear are refused.

use std::collections::HashMap;

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    beside::{self, Beside},
    budget::{MOST_ARRAYS, MOST_HEADER_LINES, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading, Rule},
};

const NAME: &str = "FITS file";
/// Size of a block, bytes: headers and data fill whole blocks (FITS standard 4.0).
const BLOCK: usize = 2880;
/// Size of a card, one key with its value in a header, bytes (FITS standard 4.0).
const CARD: usize = 80;

/// Largest change of one coordinate along the whole other axis of the map, in steps of that coordinate. A map with more
/// is refused as turned or sheared. Larger: accepts maps on oblique axes, and places pixels wrongly by this fraction of
/// a step. Smaller: refuses maps whose matrix has rounding errors. Chosen: coordinates may depart from equal steps by
/// as much.
const MOST_SLANT: f64 = 1e-4;

/// Returns true if `wanted` is the number or the EXTNAME of the header and data unit (HDU) with the number `hdu` and
/// the EXTNAME `name`. Returns false for `None`.
fn is_called(wanted: Option<&str>, hdu: usize, name: &str) -> bool {
    wanted.is_some_and(|wanted| match wanted.parse::<usize>() {
        Ok(number) => number == hdu,
        Err(_) => wanted.eq_ignore_ascii_case(name),
    })
}

/// Returns the images with two axes, the number of all header and data units (HDUs), and true if an image is
/// compressed. Refuses a `requested` HDU [map, mask] that is no image with two axes, damaged headers, and too many
/// HDUs.
fn images(
    b: &Bytes<'_>,
    requested: [Option<&str>; 2],
) -> Result<(Vec<Image>, usize, bool), Invalid> {
    let mut images = Vec::new();
    let mut start = 0;
    let mut index = 0;
    let mut is_compressed = false;
    // What follows the last unit is no concern of a reader.
    while index == 0 || b.all.get(start..).is_some_and(|rest| rest.starts_with(b"XTENSION")) {
        let (header, data_at) = header(b, start)?;
        let sizes = header.sizes()?;
        start = data_at + blocks(header.data_bytes(&sizes)?);
        let image = index == 0 || header.text("XTENSION").as_deref() == Some("IMAGE");
        let has_map = sizes.len() >= 2 && sizes[2..].iter().all(|n| *n == 1);
        is_compressed |= header.raw("ZIMAGE").is_some();
        let name = header.text("EXTNAME").unwrap_or_default();
        if image && has_map {
            images.push(Image {
                hdu: index,
                header,
                at: data_at,
                size: [sizes[1], sizes[0]],
                name,
            });
        } else if requested.iter().any(|wanted| is_called(*wanted, index, &name)) {
            let problem = format!("has in HDU {index} no image with two axes (NAXISn {sizes:?})");
            return Err(Invalid::whole(NAME, problem, "give another number"));
        }
        index += 1;
        if index > MOST_ARRAYS {
            let remedy = "export only the map";
            return Err(too_many(NAME, MOST_ARRAYS, "header and data units", remedy));
        }
    }
    Ok((images, index, is_compressed))
}

/// Reads the image of the header and data unit (HDU) that `pick.dataset` names by number (0 is the primary one) or
/// EXTNAME. Without a name it is the only image that is no mask.
///
/// # Errors
/// Refuses damaged files, several images without a name, names of coordinates or of an absent mask, and axes that are
/// turned or not linear.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if pick.x.is_some() || pick.y.is_some() {
        let remedy = "FITS has its coordinates in the header; leave out `x` and `y`";
        return Err(Invalid::whole(NAME, "has no arrays of coordinates", remedy));
    }
    let [wanted, wanted_mask] = [pick.dataset.as_deref(), pick.mask.as_deref()];
    let b = Bytes { all: bytes, name: NAME, big_endian: true };
    if !bytes.starts_with(b"SIMPLE  =") {
        let problem = "does not start with SIMPLE";
        return Err(Invalid::whole(NAME, problem, "give a FITS file, or the right `format`"));
    }
    let (images, index, is_compressed) = images(&b, [wanted, wanted_mask])?;
    let is_mask = |image: &Image| match wanted_mask {
        Some(_) => is_called(wanted_mask, image.hdu, &image.name),
        None => image.name.eq_ignore_ascii_case("MASK"),
    };
    let image = match wanted {
        Some(_) => images.iter().find(|image| is_called(wanted, image.hdu, &image.name)),
        None => {
            let maps: Vec<&Image> = images.iter().filter(|image| !is_mask(image)).collect();
            if maps.len() > 1 {
                let named = maps.iter().take(20).map(|image| image.label());
                let listed = named.collect::<Vec<_>>().join(", ");
                let problem = format!("holds {} images: {listed}", maps.len());
                let remedy = "choose the map with `dataset`; `mask` names an image that is not 0 at invalid pixels";
                return Err(Invalid::whole(NAME, problem, remedy));
            }
            maps.first().copied()
        }
    };
    let Some(image) = image else {
        let remedy = if is_compressed {
            "an image is compressed: unpack it with funpack"
        } else {
            "give a file with a map, or another `dataset`"
        };
        let problem = match wanted {
            Some(hdu) => format!("has no HDU \"{hdu}\", only {index}"),
            None => format!("has no image with two axes in {index} HDU(s)"),
        };
        return Err(Invalid::whole(NAME, problem, remedy));
    };
    let mut reading = map(&b, image)?;
    let masks: Vec<&Image> = images.iter().filter(|m| is_mask(m) && m.hdu != image.hdu).collect();
    if let (Some(hdu), []) = (wanted_mask, &masks[..]) {
        let problem = format!("has no HDU {hdu} beside the map");
        let remedy = "give the number or the name of another image";
        return Err(Invalid::whole("mask", problem, remedy));
    }
    for mask in masks {
        let values = numbers(&b, mask)?;
        reading.apply_mask(&mask.label(), &values)?;
        if let Some(stated) = reading.stated.as_object_mut() {
            stated.insert("mask_hdu".into(), mask.hdu.into());
        }
    }
    Ok(reading)
}

/// An image with two axes in a FITS file.
struct Image {
    hdu: usize,
    header: Header,
    /// Offset of its numbers in the file, bytes.
    at: usize,
    /// Number of rows and columns.
    size: [usize; 2],
    /// Name of the extension (EXTNAME); empty without one.
    name: String,
}

impl Image {
    /// Returns the number of the header and data unit and its name, for a message.
    fn label(&self) -> String {
        match self.name.as_str() {
            "" => format!("HDU {}", self.hdu),
            name => format!("HDU {} {}", self.hdu, name.chars().take(40).collect::<String>()),
        }
    }
}

/// Returns the numbers of an image as stored, without scale and offset (rows, columns). Refuses a truncated one.
fn numbers(b: &Bytes, image: &Image) -> Result<Array2<f64>, Invalid> {
    let [rows, columns] = image.size;
    let count = check_size("FITS image", rows, columns)?;
    let number = image.header.number()?;
    let raw = b.slice(image.at, count * number.size())?;
    let values = number.decode(raw, count, true)?;
    Ok(Array2::from_shape_vec((rows, columns), values).expect("one value per pixel"))
}

/// Reads the map from its image: numbers, unit, coordinates and invalid pixels. Refuses damaged numbers or cards, and
/// axes that are turned or not linear.
fn map(b: &Bytes, image: &Image) -> Result<Reading, Invalid> {
    let header = &image.header;
    let number = header.number()?;
    let mut reading = Reading::new(Format::Fits, numbers(b, image)?, FirstRow::SmallestY);
    reading.single = number == Number::F32;
    if let Some(blank) = header.float("BLANK")?.filter(|_| number.is_integer()) {
        reading.invalidate(blank);
    }
    // value = BZERO + BSCALE raw
    let zero = header.float("BZERO")?.unwrap_or(0.0);
    let scale = header.float("BSCALE")?.unwrap_or(1.0);
    reading.offset = zero;
    reading.factor = scale;
    let unit_name = header.text("BUNIT").filter(|u| !u.is_empty());
    if let Some(name) = &unit_name {
        reading.state_unit("BUNIT", name);
    }
    let [rows, columns] = image.size;
    reading.rule = header.rule([columns, rows], &mut reading.warnings)?;
    header.statements()?.apply(&mut reading)?;
    reading.stated =
        json!({ "hdu": image.hdu, "bunit": unit_name, "bscale": scale, "bzero": zero });
    Ok(reading)
}

impl Number {
    /// Returns true if the type is that of integers.
    fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// The cards of a FITS header by their keys (of repeated keys the first), and the texts of COMMENT and HISTORY.
struct Header(HashMap<String, String>, Vec<String>);

/// Beginnings of keys of cards that the reader handles itself, or that say nothing about the values.
const READ: [&str; 24] = [
    "SIMPLE", "BITPIX", "NAXIS", "EXTEND", "BSCALE", "BZERO", "BLANK", "BUNIT", "CDELT", "CRVAL",
    "CRPIX", "CUNIT", "CTYPE", "CD", "PC", "CROTA", "XTENSION", "PCOUNT", "GCOUNT", "EXTNAME",
    "EXTVER", "DATE", "DATAM", "CHECKSUM",
];

/// Largest number of cards, and of comments, that are read as statements. Larger: more time on long headers. Smaller: a
/// statement after a long history is not seen.
const MOST_STATEMENTS: usize = 1000;

/// Reads the header that begins at byte `start`. Returns it with the offset of its data, bytes. Refuses cards that are
/// no text, too many cards, and a header without END.
fn header(b: &Bytes, start: usize) -> Result<(Header, usize), Invalid> {
    let mut cards = HashMap::new();
    let mut comments = Vec::new();
    let mut next = start;
    loop {
        let card = b.slice(next, CARD)?;
        if !card.iter().all(|c| (0x20..0x7f).contains(c)) {
            let problem = format!("has a card that is not text at byte {next}");
            return Err(Invalid::whole(NAME, problem, "write it again"));
        }
        next += CARD;
        let card = String::from_utf8_lossy(card).into_owned();
        let (key, rest) = card.split_at(8);
        if key.trim_end() == "END" {
            return Ok((Header(cards, comments), start + blocks(next - start)));
        }
        if matches!(key.trim_end(), "COMMENT" | "HISTORY") && comments.len() < MOST_STATEMENTS {
            comments.push(rest.trim().to_string());
        }
        if let Some(value) = rest.strip_prefix("= ") {
            if cards.len() == MOST_HEADER_LINES {
                let remedy = "write it again, without its history";
                return Err(too_many(NAME, MOST_HEADER_LINES, "cards in a header", remedy));
            }
            let key = key.trim_end().to_string();
            cards.entry(key).or_insert_with(|| value.trim().to_string());
        }
    }
}

/// Returns the number of bytes rounded up to whole blocks of 2880.
fn blocks(bytes: usize) -> usize {
    bytes.div_ceil(BLOCK).saturating_mul(BLOCK)
}

impl Header {
    /// Returns the value of a card as text, with its comment; `None` without the card or its value.
    fn raw(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    /// Returns the string of a card, without its quotation marks; `None` if the card is absent or has no string.
    fn text(&self, key: &str) -> Option<String> {
        let value = self.raw(key)?.strip_prefix('\'')?;
        value.split('\'').next().map(|t| t.trim_end().to_string())
    }

    /// Returns the number of a card; `None` without the card. Refuses a value that is no number.
    fn float(&self, key: &str) -> Result<Option<f64>, Invalid> {
        let Some(raw) = self.raw(key) else { return Ok(None) };
        let value = raw.split('/').next().unwrap_or_default().trim();
        // Fortran writes D for the exponent of a double.
        value.replace(['D', 'd'], "E").parse().map(Some).map_err(|_| {
            let problem = format!("has \"{value}\" in card {key}, where a number should be");
            Invalid::whole(NAME, problem, "write it again")
        })
    }

    /// Returns the statements in cards outside the standard, such as `PIXSIZE = 0.5 / [mm] pixel size`, and in
    /// comments.
    fn statements(&self) -> Result<Beside, Invalid> {
        let mut beside = Beside::default();
        let mut cards: Vec<(&String, &String)> = self.0.iter().collect();
        cards.sort();
        let others =
            cards.into_iter().filter(|(key, _)| !READ.iter().any(|start| key.starts_with(start)));
        for (i, (key, card)) in others.take(MOST_STATEMENTS).enumerate() {
            let (value, comment) = match card.strip_prefix('\'') {
                Some(text) => text.split_once('\'').unwrap_or((text, "")),
                None => card.split_once('/').unwrap_or((card, "")),
            };
            let comment = comment.trim_start_matches([' ', '/']);
            let unit = comment
                .strip_prefix('[')
                .and_then(|rest| rest.split_once(']'))
                .map(|(unit, _)| unit);
            let is_used = beside.add(key, value.trim(), unit, 2 * i)?;
            let is_telling = beside::is_telling(key) || beside::is_telling(comment);
            if !is_used && is_telling && value.trim().parse::<f64>().is_ok_and(|v| v != 0.0) {
                beside.leave(&format!("{key} = {card}"), "card");
            }
        }
        for (i, comment) in self.1.iter().enumerate() {
            beside.add_comment(comment, i + 1)?;
        }
        Ok(beside)
    }

    /// Returns the whole number of a card, 0 or more. Refuses a header without such a number.
    fn whole(&self, key: &str) -> Result<usize, Invalid> {
        let value = self.float(key)?.filter(|v| *v >= 0.0 && *v < 1e15 && v.fract() == 0.0);
        value.map(|v| v as usize).ok_or_else(|| {
            let problem = format!("has no card {key} with a count");
            Invalid::whole(NAME, problem, "write it again")
        })
    }

    /// Returns the rule of the coordinates of the pixels, or `None` if the header lacks the step of an axis. `len` is
    /// the number of pixels along [x, y]. Refuses axes that are turned, sheared or not linear, steps of 0, and unknown
    /// units.
    fn rule(&self, len: [usize; 2], warnings: &mut Vec<String>) -> Result<Option<Rule>, Invalid> {
        let refuse = |problem: String, remedy: &str| Err(Invalid::whole(NAME, problem, remedy));
        let remedy = "write the map on axes of length, or delete these cards and give `pixel_mm`";
        let mut steps = [None; 2];
        let mut unit = [None; 2];
        let mut reference = [(0.0, 0.0); 2];
        for (k, n) in [1, 2].into_iter().enumerate() {
            let step_key = format!("CDELT{n}");
            // If CDn_n is there, it is the whole step, and CDELTn does not multiply it.
            steps[k] = match (self.float(&format!("CD{n}_{n}"))?, self.float(&step_key)?) {
                (Some(step), _) => Some(step),
                (None, Some(step)) => {
                    Some(step * self.float(&format!("PC{n}_{n}"))?.unwrap_or(1.0))
                }
                (None, None) => None,
            };
            if let Some(step) = steps[k].filter(|step| !(step.is_finite() && *step != 0.0)) {
                let remedy = "correct the header, or delete CDELT and give `pixel_mm`";
                return refuse(format!("has {step_key} = {step}"), remedy);
            }
            if let Some(kind) = self.text(&format!("CTYPE{n}")).filter(|t| t.get(4..5) == Some("-"))
            {
                return refuse(
                    format!("has CTYPE{n} \"{kind}\", an axis that is not linear"),
                    remedy,
                );
            }
            let name = self.text(&format!("CUNIT{n}")).filter(|u| !u.is_empty());
            unit[k] = name.map(|name| Unit::stated("CUNIT", &name)).transpose()?;
            // Pixels are counted from 1; what is not in the header is 0.
            reference[k] = (
                self.float(&format!("CRPIX{n}"))?.unwrap_or(0.0) - 1.0,
                self.float(&format!("CRVAL{n}"))?.unwrap_or(0.0),
            );
        }
        let keys = ["CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2"];
        let stated: Vec<&str> = keys.into_iter().filter(|key| self.raw(key).is_some()).collect();
        if let Some((pixel, value)) = reference.iter().find(|r| !(r.0 + r.1).is_finite()) {
            return refuse(format!("has CRPIX {pixel} or CRVAL {value}"), "correct the header");
        }
        let [Some(x), Some(y)] = steps else {
            if !stated.is_empty() || steps != [None; 2] {
                let rest = ["CDELT1", "CDELT2"].into_iter().zip(steps).filter(|(_, s)| s.is_some());
                let all: Vec<&str> = stated.into_iter().chain(rest.map(|(key, _)| key)).collect();
                let why = "the header has not the steps of both axes";
                warnings.push(format!("{} not used: {why}", all.join(", ")));
            }
            return Ok(None);
        };
        // Change of the other coordinate along the whole axis, against its step.
        for ((row, column), across) in [((1, 2), x), ((2, 1), y)] {
            let (key, scale) = match self.float(&format!("CD{row}_{column}"))? {
                Some(_) => (format!("CD{row}_{column}"), 1.0),
                None => {
                    let cdelt = self.float(&format!("CDELT{row}"))?.unwrap_or(1.0);
                    (format!("PC{row}_{column}"), cdelt)
                }
            };
            let slant = self.float(&key)?.unwrap_or(0.0);
            let beside = (slant * scale * len[column - 1] as f64).abs();
            if !beside.is_finite() || beside > MOST_SLANT * f64::abs(across) {
                return refuse(format!("has {key} = {slant}: the map lies at an angle"), remedy);
            }
        }
        if let Some(angle) = self.float("CROTA2")?.filter(|angle| *angle != 0.0) {
            return refuse(format!("has CROTA2 = {angle}: the map lies at an angle"), remedy);
        }
        let reference = if stated.is_empty() { None } else { Some(reference) };
        Ok(Some(Rule { step: [x, y], unit, reference }))
    }

    /// Returns the lengths of the axes, NAXIS1, NAXIS2, ...; NAXIS1 is the number of columns. Refuses a header without
    /// them, and more than 999 axes.
    fn sizes(&self) -> Result<Vec<usize>, Invalid> {
        let n = self.whole("NAXIS")?;
        if n > 999 {
            return Err(Invalid::whole(NAME, format!("has {n} axes"), "write it again"));
        }
        (1..=n).map(|i| self.whole(&format!("NAXIS{i}"))).collect()
    }

    /// Returns the type of the numbers, from BITPIX. Refuses other values than those of the standard.
    fn number(&self) -> Result<Number, Invalid> {
        match self.float("BITPIX")? {
            Some(8.0) => Ok(Number::U8),
            Some(16.0) => Ok(Number::I16),
            Some(32.0) => Ok(Number::I32),
            Some(64.0) => Ok(Number::I64),
            Some(-32.0) => Ok(Number::F32),
            Some(-64.0) => Ok(Number::F64),
            other => Err(Invalid::whole(NAME, format!("has BITPIX {other:?}"), "write it again")),
        }
    }

    /// Returns the size of the data, bytes: BITPIX / 8 x GCOUNT x (PCOUNT + NAXIS1 x ...). Refuses 2^60 bytes and more.
    fn data_bytes(&self, sizes: &[usize]) -> Result<usize, Invalid> {
        let each = self.number()?.size();
        let groups = if self.raw("GCOUNT").is_some() { self.whole("GCOUNT")? } else { 1 };
        let heap = if self.raw("PCOUNT").is_some() { self.whole("PCOUNT")? } else { 0 };
        let elements = match sizes {
            [] => Some(0),
            _ => sizes.iter().try_fold(1usize, |n, s| n.checked_mul(*s)),
        };
        let bytes = elements
            .and_then(|n| n.checked_add(heap))
            .and_then(|n| n.checked_mul(groups))
            .and_then(|n| n.checked_mul(each));
        bytes.filter(|n| *n < 1 << 60).ok_or_else(|| {
            Invalid::whole(NAME, format!("claims the axes {sizes:?}"), "write it again")
        })
    }
}
