//! An SVG document and its elements. Coordinates are pixels of the picture, y downwards.

use std::fmt::{Arguments, Write};

use planish_types::text::escaped;

/// SVG attribute that centres a text at the point where it is written.
pub const MIDDLE: &str = "text-anchor=\"middle\"";

/// SVG attribute that lets a text end at the point where it is written.
pub const END: &str = "text-anchor=\"end\"";

/// An SVG picture under construction: the elements drawn so far, as text.
#[derive(Clone, Debug)]
pub struct Svg {
    font_px: f64,
    elements: String,
}

impl Svg {
    /// Creates an empty picture with a white background. Its texts are `font_px` high unless their attributes say
    /// otherwise.
    pub fn new(font_px: f64) -> Self {
        Self { font_px, elements: String::new() }
    }

    /// Returns the height of the texts of the picture, px.
    pub(crate) fn font_px(&self) -> f64 {
        self.font_px
    }

    /// Adds one line of SVG markup unchanged; the caller escapes text that a user wrote.
    pub fn put(&mut self, markup: Arguments<'_>) {
        put(&mut self.elements, markup);
        self.elements.push('\n');
    }

    /// Adds a rectangle of this width and height, px, whose upper left corner is at [x, y]. `attributes` are SVG
    /// attributes such as its colour.
    pub fn rectangle(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], attributes: &str) {
        self.put(format_args!(
            "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" {attributes}/>"
        ));
    }

    /// Adds a path with SVG `attributes` and the path data `d`; nothing if `d` is empty.
    pub fn path(&mut self, attributes: &str, d: &str) {
        if !d.is_empty() {
            self.put(format_args!("<path {attributes} d=\"{d}\"/>"));
        }
    }

    /// Adds the text `words`, escaped. It starts at the point [x, y] (its baseline), unless SVG `attributes` such as
    /// [`MIDDLE`] change that.
    pub fn text(&mut self, [x, y]: [f64; 2], attributes: &str, words: &str) {
        let space = if attributes.is_empty() { "" } else { " " };
        let words = escaped(words);
        self.put(format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\"{space}{attributes}>{words}</text>"));
    }

    /// Adds the text `words`, escaped, rotated so that it reads upwards. It is centred at the point [x, y].
    pub(crate) fn upward_text(&mut self, [x, y]: [f64; 2], words: &str) {
        let words = escaped(words);
        self.put(format_args!(
            "<text transform=\"translate({x:.1} {y:.1}) rotate(-90)\" {MIDDLE}>{words}</text>"
        ));
    }

    /// Returns the SVG document. Its size is [width, height] px, each rounded up to a whole pixel.
    pub fn finish(self, size_px: [f64; 2]) -> String {
        let [width, height] = size_px.map(f64::ceil);
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"{}\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{}</svg>\n",
            self.font_px, self.elements
        )
    }
}

/// Appends formatted text to `out`. It ignores the result, since writing to a string cannot fail.
pub fn put(out: &mut String, words: Arguments<'_>) {
    let _ = out.write_fmt(words);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_holds_what_was_put_and_no_markup_of_a_user() {
        let mut svg = Svg::new(14.0);
        svg.text([1.0, 2.0], "", "a < b & \u{1b}");
        svg.text([1.0, 2.0], END, "end");
        svg.upward_text([3.0, 4.0], "<y>");
        svg.path("stroke=\"#000000\"", "");
        svg.rectangle([0.0, 0.5], [2.0, 1.0], "fill=\"#dddddd\"");
        let text = svg.finish([10.2, 20.0]);
        assert_eq!(
            text,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"11\" height=\"20\" viewBox=\"0 0 11 20\" \
             font-family=\"sans-serif\" font-size=\"14\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
             <text x=\"1.0\" y=\"2.0\">a &lt; b &amp; \\u{1b}</text>\n\
             <text x=\"1.0\" y=\"2.0\" text-anchor=\"end\">end</text>\n\
             <text transform=\"translate(3.0 4.0) rotate(-90)\" text-anchor=\"middle\">&lt;y&gt;</text>\n\
             <rect x=\"0.00\" y=\"0.50\" width=\"2.00\" height=\"1.00\" fill=\"#dddddd\"/>\n</svg>\n"
        );
    }
}
