//! Conversion of a figure to PDF or PNG, with the same bytes on every machine: the font comes with the program.
//!
//! ```text
//! PDF: 180 mm wide, texts embedded as a subset of the font      PNG: the same size, by default 300 pixels an inch
//! ```
//!
//! The font is DejaVu Sans (crate `dejavu`; the licence of the fonts is that of Bitstream Vera), the conversion that of
//! `svg2pdf` and `resvg`.

use std::{ops::RangeInclusive, sync::Arc};

use planish_types::Invalid;
use png::{ColorType, Compression, Encoder};
use resvg::{
    tiny_skia::{Color, Pixmap, Transform},
    usvg::{self, fontdb::Database},
};
use svg2pdf::{ConversionOptions, PageOptions};

use crate::report::figure::PAPER_PX;

/// Width of a figure in print, mm. Larger or smaller: the figure is scaled in print. Chosen: both columns of a page.
const PAPER_MM: f64 = 180.0;

/// Default resolution of a PNG, pixels per inch. Larger: larger files. Smaller: less sharp print. Chosen: the
/// resolution that journals ask for.
pub const PNG_DPI: f64 = 300.0;

/// Allowed resolutions of a PNG, pixels per inch. Wider: very large files, or texts that cannot be read. Narrower:
/// sensible resolutions are refused. Chosen: from that of a screen to that of the finest print.
pub const PNG_DPI_RANGE: RangeInclusive<f64> = 72.0..=1200.0;

const MM_PER_INCH: f64 = 25.4;

/// Returns the scale of the drawing: pixels of the SVG per inch in print.
fn drawn_per_inch() -> f64 {
    PAPER_PX / PAPER_MM * MM_PER_INCH
}

/// Converts the figure in `svg` to a PDF whose single page has the size of the figure.
///
/// # Errors
/// Fails if the figure cannot be converted.
pub fn pdf(svg: &str) -> Result<Vec<u8>, Invalid> {
    let page = PageOptions { dpi: drawn_per_inch() as f32 };
    let pdf = svg2pdf::to_pdf(&parsed(svg)?, ConversionOptions::default(), page);
    pdf.map(in_order).map_err(|e| unprintable(&e.to_string()))
}

/// Sorts the entries in the resource dictionaries of a PDF by their names.
///
/// `svg2pdf` 0.13 writes them in the order of a hash table, which differs from run to run. An entry is a line, such
/// as `/xo1 12 0 R`. Lines that change places within their dictionary move no object, so the table of offsets stays
/// right.
fn in_order(pdf: Vec<u8>) -> Vec<u8> {
    let mut lines: Vec<&[u8]> = pdf.split(|b| *b == b'\n').collect();
    for entries in lines.chunk_by_mut(|a, b| is_entry(a) && is_entry(b)) {
        entries.sort();
    }
    lines.join(&b'\n')
}

/// Returns true if a line of a PDF is an entry of a resource dictionary.
fn is_entry(line: &[u8]) -> bool {
    let line = line.trim_ascii();
    line.starts_with(b"/")
        && line.ends_with(b" 0 R")
        && line.iter().filter(|b| **b == b'/').count() == 1
}

/// Converts the figure in `svg` to a PNG with a resolution of `dpi` pixels per inch of the print.
///
/// # Errors
/// Fails if the figure cannot be converted, or if it is too large for the memory.
pub fn png(svg: &str, dpi: f64) -> Result<Vec<u8>, Invalid> {
    let tree = parsed(svg)?;
    let scale = (dpi / drawn_per_inch()) as f32;
    let [width, height] =
        [tree.size().width(), tree.size().height()].map(|px| (px * scale).round() as u32);
    let size = format!("{width} x {height} pixels");
    let mut pixels = Pixmap::new(width, height).ok_or_else(|| unprintable(&size))?;
    // The last column and row may reach beyond the drawing by a part of a pixel.
    pixels.fill(Color::WHITE);
    resvg::render(&tree, Transform::from_scale(scale, scale), &mut pixels.as_mut());
    // Paper is opaque: the colours alone are stored.
    let colours: Vec<u8> =
        pixels.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height);
    encoder.set_color(ColorType::Rgb);
    encoder.set_compression(Compression::High);
    let written = encoder.write_header().and_then(|mut w| w.write_image_data(&colours));
    written.map_err(|e| unprintable(&e.to_string()))?;
    Ok(bytes)
}

fn parsed(svg: &str) -> Result<usvg::Tree, Invalid> {
    let mut fonts = Database::new();
    fonts.load_font_data(dejavu::sans::regular().to_vec());
    fonts.set_sans_serif_family("DejaVu Sans");
    let options = usvg::Options { fontdb: Arc::new(fonts), ..usvg::Options::default() };
    usvg::Tree::from_str(svg, &options).map_err(|e| unprintable(&e.to_string()))
}

fn unprintable(problem: &str) -> Invalid {
    let problem = format!("cannot be converted ({problem})");
    Invalid::whole("figure", problem, "draw it as svg")
}

#[cfg(test)]
mod tests {
    use super::*;

    const SVG: &str = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"952\" height=\"100\" viewBox=\"0 0 952 100\" \
        font-family=\"sans-serif\" font-size=\"14\"><rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\
        <rect x=\"476\" width=\"476\" height=\"50\" fill=\"#3a7db8\"/>TEXT</svg>";

    #[test]
    fn a_page_is_180_mm_wide_and_has_the_font_in_it() {
        let with_text = SVG.replace("TEXT", "<text x=\"10\" y=\"80\">residual (nm)</text>");
        let page = pdf(&with_text).unwrap();
        let text = String::from_utf8_lossy(&page);
        assert!(text.starts_with("%PDF-1."));
        let (_, size) = text.split_once("/MediaBox [").unwrap();
        let size: Vec<f64> = size
            .split(']')
            .next()
            .unwrap()
            .split_whitespace()
            .map(|v| v.parse().unwrap())
            .collect();
        // 180 mm in points of 1/72 inch, stored in 32 bits.
        let wanted = [0.0, 0.0, 510.236, 510.236 * 100.0 / 952.0];
        assert!(size.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-3), "{size:?}");
        assert!(text.contains("DejaVuSans"), "the font is embedded");
        assert!(!text.contains("/CreationDate") && !text.contains("/ModDate"));
        assert_eq!(page, pdf(&with_text).unwrap());
        assert!(
            !String::from_utf8_lossy(&pdf(&SVG.replace("TEXT", "")).unwrap()).contains("DejaVu")
        );
    }

    #[test]
    fn a_png_has_300_pixels_an_inch_and_the_colours_at_their_places() {
        let bytes = png(&SVG.replace("TEXT", ""), PNG_DPI).unwrap();
        let decoded = Pixmap::decode_png(&bytes).unwrap();
        // 180 mm / 25.4 mm * 300 = 2125.98.
        assert_eq!((decoded.width(), decoded.height()), (2126, 223));
        let at = |x, y| {
            let p = decoded.pixel(x, y).unwrap();
            [p.red(), p.green(), p.blue()]
        };
        assert_eq!(
            (at(1700, 50), at(400, 50), at(1700, 180)),
            ([0x3a, 0x7d, 0xb8], [255; 3], [255; 3])
        );
        // The last column is half of a pixel of the drawing at 110 pixels an inch: 952 / 134.34 * 110 = 779.5.
        let coarse = Pixmap::decode_png(&png(&SVG.replace("TEXT", ""), 110.0).unwrap()).unwrap();
        let last = coarse.pixel(coarse.width() - 1, coarse.height() - 1).unwrap();
        assert_eq!([last.red(), last.green(), last.blue()], [255; 3]);
        // Letters are drawn: the same place is dark where there is a text.
        let dark = |svg: &str| {
            let drawn = Pixmap::decode_png(&png(svg, PNG_DPI).unwrap()).unwrap();
            drawn.pixels().iter().filter(|p| p.blue() < 64).count()
        };
        let with_text = SVG.replace("TEXT", "<text x=\"10\" y=\"80\">residual (nm)</text>");
        assert!(dark(&with_text) > 500 && dark(&SVG.replace("TEXT", "")) == 0);
    }

    #[test]
    fn entries_of_a_dictionary_are_in_order_and_nothing_else_is_moved() {
        let pdf = "  /XObject <<\n    /xo1 9 0 R\n    /xo0 7 0 R\n  >>\n  /B 1\n  /A 2\n    /xo3 1 0 R\n%%EOF\n";
        let found = String::from_utf8(in_order(pdf.as_bytes().to_vec())).unwrap();
        let wanted = "  /XObject <<\n    /xo0 7 0 R\n    /xo1 9 0 R\n  >>\n  /B 1\n  /A 2\n    /xo3 1 0 R\n%%EOF\n";
        assert_eq!(found, wanted);
    }

    #[test]
    fn what_is_no_drawing_is_told() {
        let message = pdf("<svg").unwrap_err().to_string();
        assert!(message.contains("figure: cannot be converted"), "{message}");
    }
}
