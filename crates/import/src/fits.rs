//! FITS images: blocks of 2880 bytes, cards of 80 characters, big-endian numbers.
//!
//! `value = BZERO + BSCALE raw`; BLANK or NaN is an invalid pixel. The unit is BUNIT, the pitch
//! |CDELTn| in CUNITn. The first row of the file is the smallest y, as the standard shows it; an
//! axis with a negative CDELT runs the other way.

use std::collections::HashMap;

use ndarray::{Array2, s};
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{MOST_ARRAYS, MOST_HEADER_LINES, check_size, too_many},
    bytes::{Bytes, Number},
    reading::{FirstRow, Pick, Reading},
};

const NAME: &str = "FITS file";
const BLOCK: usize = 2880;
const CARD: usize = 80;

/// Reads the image of the HDU whose number (0, the primary, first) is `pick.dataset`, else the first.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    if pick.x.is_some() || pick.y.is_some() {
        let remedy = "FITS has its coordinates in the header; leave out `x` and `y`";
        return Err(Invalid::whole(NAME, "has no arrays of coordinates", remedy));
    }
    let wanted = match &pick.dataset {
        None => None,
        Some(text) => Some(text.parse::<usize>().map_err(|_| {
            let remedy = "give the number of the HDU, 0 for the primary one";
            Invalid::whole(NAME, format!("has no dataset \"{text}\""), remedy)
        })?),
    };
    let b = Bytes { all: bytes, name: NAME, big_endian: true };
    if !bytes.starts_with(b"SIMPLE  =") {
        let problem = "does not start with SIMPLE";
        return Err(Invalid::whole(NAME, problem, "give a FITS file, or the right `format`"));
    }
    let (mut at, mut index) = (0, 0);
    while at < bytes.len() {
        let (header, data_at) = header(&b, at)?;
        let sizes = header.sizes()?;
        let image = index == 0 || header.text("XTENSION").as_deref() == Some("IMAGE");
        let has_map = sizes.len() >= 2 && sizes[2..].iter().all(|n| *n == 1);
        let here = wanted.is_none_or(|w| w == index);
        if here && image && has_map {
            return map(&b, &header, data_at, sizes[1], sizes[0], index);
        }
        if here && wanted.is_some() {
            let problem = format!("has in HDU {index} no image with two axes (NAXISn {sizes:?})");
            return Err(Invalid::whole(NAME, problem, "give another `dataset`"));
        }
        at = data_at + blocks(header.data_bytes(&sizes)?);
        index += 1;
        if index > MOST_ARRAYS {
            let remedy = "export only the map";
            return Err(too_many(NAME, MOST_ARRAYS, "header and data units", remedy));
        }
    }
    let remedy = "give a file with a map, or another `dataset`";
    Err(Invalid::whole(NAME, format!("has no image with two axes in {index} HDU(s)"), remedy))
}

fn map(
    b: &Bytes,
    header: &Header,
    at: usize,
    rows: usize,
    columns: usize,
    hdu: usize,
) -> Result<Reading, Invalid> {
    let count = check_size("FITS image", rows, columns)?;
    let number = header.number()?;
    let raw = b.slice(at, count * number.size())?;
    let mut values = number.decode(raw, count, true)?;
    if let Some(blank) =
        header.float("BLANK")?.filter(|_| number.size() <= 8 && number.is_integer())
    {
        for v in values.iter_mut().filter(|v| **v == blank) {
            *v = f64::NAN;
        }
    }
    let (zero, scale) =
        (header.float("BZERO")?.unwrap_or(0.0), header.float("BSCALE")?.unwrap_or(1.0));
    if (zero, scale) != (0.0, 1.0) {
        // value = BZERO + BSCALE raw
        values.iter_mut().for_each(|v| *v = zero + scale * *v);
    }
    let mut values = Array2::from_shape_vec((rows, columns), values).expect("one value per pixel");

    let unit_name = header.text("BUNIT").filter(|u| !u.is_empty());
    let unit = unit_name.as_deref().map(|u| Unit::stated("BUNIT", u)).transpose()?;
    let mut pitch_mm = Vec::new();
    let mut warnings = Vec::new();
    for axis in 1..=2 {
        let Some(step) = header.float(&format!("CDELT{axis}"))? else { continue };
        let key = format!("CUNIT{axis}");
        let Some(name) = header.text(&key).filter(|u| !u.is_empty()) else {
            warnings.push(format!("CDELT{axis} is {step} without {key}: not used"));
            continue;
        };
        let to_mm = Unit::stated("CUNIT", &name)?.mm()?;
        if !(step.is_finite() && step != 0.0) {
            let remedy = "correct the header, or delete CDELT and give `pitch_mm`";
            return Err(Invalid::whole(NAME, format!("has CDELT{axis} = {step}"), remedy));
        }
        if step < 0.0 {
            let flipped = if axis == 1 { s![.., ..;-1] } else { s![..;-1, ..] };
            values = values.slice(flipped).to_owned();
            warnings.push(format!("CDELT{axis} is negative: the axis was reversed"));
        }
        pitch_mm.push(step.abs() * to_mm);
    }
    let mut reading = Reading::new(Format::Fits, values, FirstRow::SmallestY);
    reading.unit = unit;
    reading.pitch_mm = <[f64; 2]>::try_from(pitch_mm).ok();
    reading.warnings = warnings;
    reading.stated = json!({ "hdu": hdu, "bunit": unit_name, "bscale": scale, "bzero": zero });
    Ok(reading)
}

impl Number {
    fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// The cards of a header; of those with one key the first.
struct Header(HashMap<String, String>);

fn header(b: &Bytes, start: usize) -> Result<(Header, usize), Invalid> {
    let mut cards = HashMap::new();
    let mut at = start;
    loop {
        let card = b.slice(at, CARD)?;
        at += CARD;
        if !card.iter().all(|c| (0x20..0x7f).contains(c)) {
            let problem = format!("has a card that is not text at byte {}", at - CARD);
            return Err(Invalid::whole(NAME, problem, "write it again"));
        }
        let card = String::from_utf8_lossy(card).into_owned();
        let (key, rest) = card.split_at(8);
        if key.trim_end() == "END" {
            return Ok((Header(cards), start + blocks(at - start)));
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

fn blocks(bytes: usize) -> usize {
    bytes.div_ceil(BLOCK).saturating_mul(BLOCK)
}

impl Header {
    fn raw(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    /// A string in quotes.
    fn text(&self, key: &str) -> Option<String> {
        let value = self.raw(key)?.strip_prefix('\'')?;
        value.split('\'').next().map(|t| t.trim_end().to_string())
    }

    fn float(&self, key: &str) -> Result<Option<f64>, Invalid> {
        let Some(raw) = self.raw(key) else { return Ok(None) };
        let value = raw.split('/').next().unwrap_or_default().trim();
        // Fortran writes D for the exponent of a double.
        value.replace(['D', 'd'], "E").parse().map(Some).map_err(|_| {
            let problem = format!("has \"{value}\" in card {key}, where a number should be");
            Invalid::whole(NAME, problem, "write it again")
        })
    }

    fn whole(&self, key: &str) -> Result<usize, Invalid> {
        let value = self.float(key)?.filter(|v| *v >= 0.0 && *v < 1e15 && v.fract() == 0.0);
        value.map(|v| v as usize).ok_or_else(|| {
            let problem = format!("has no card {key} with a count");
            Invalid::whole(NAME, problem, "write it again")
        })
    }

    /// NAXIS1, NAXIS2, ...
    fn sizes(&self) -> Result<Vec<usize>, Invalid> {
        let n = self.whole("NAXIS")?;
        if n > 999 {
            return Err(Invalid::whole(NAME, format!("has {n} axes"), "write it again"));
        }
        (1..=n).map(|i| self.whole(&format!("NAXIS{i}"))).collect()
    }

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

    /// BITPIX / 8 x GCOUNT x (PCOUNT + NAXIS1 x ...)
    fn data_bytes(&self, sizes: &[usize]) -> Result<usize, Invalid> {
        let each = self.number()?.size();
        let or = |key: &str, default| match self.raw(key) {
            Some(_) => self.whole(key),
            None => Ok(default),
        };
        let (groups, heap) = (or("GCOUNT", 1)?, or("PCOUNT", 0)?);
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
