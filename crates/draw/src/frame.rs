//! A plot: a rectangle of the picture with an axis along x and one along y.

use planish_types::text::{escaped, significant};

use crate::{
    colour::{Bands, INK},
    svg::{END, MIDDLE, Svg, put},
    ticks::{round_logarithms, round_numbers},
};

/// Length of axis that each number beside it needs, px. Larger: fewer numbers. Smaller: numbers overlap. The
/// value is the same along x and y, so that two axes of one range and length have the same steps.
const PX_PER_NUMBER: f64 = 50.0;

/// Significant digits of the numbers beside an axis. Larger: rounding errors such as 0.30000000000000004 show.
/// Smaller: a round number could lose digits. Chosen: more than a round number has, fewer than a 64-bit float.
const AXIS_DIGITS: usize = 10;

/// Significant digits of the two numbers at the ends of a colour bar. Larger: longer texts that need a wider margin.
/// Smaller: the range is rounded more coarsely.
const BAR_DIGITS: usize = 4;

/// Length of a tick mark, px. Larger: numbers stand farther from the axis, and need a wider margin.
const MARK_PX: f64 = 5.0;

/// Smallest height of a colour bar, px, also beside a plot that is lower. Smaller: the numbers at its ends overlap
/// its unit. Larger: the bar of a low plot extends farther below its frame.
const LEAST_BAR_PX: f64 = 100.0;

/// Distance of the baseline of a note (see `Frame::note`) from the lower edge of the picture, px. Smaller: the
/// descenders of its letters are cut off. Larger: it comes closer to the title of the x axis. Derived: a fourth of
/// its font of 11 px, and one pixel of paper.
const NOTE_DESCENT_PX: f64 = 4.0;

/// Distance of a colour bar from the right edge of its frame, and width of the bar, px. Larger: less room for its
/// numbers in the right margin.
const BAR_PX: [f64; 2] = [14.0, 12.0];

/// Range of the values on an axis, and the rule (linear or logarithmic) that places them along it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// Linear axis from the first value to the second, in the unit of the values; the first is smaller.
    Linear([f64; 2]),
    /// Linear axis of a count, from the first value to the second. Only whole numbers stand beside it.
    Counts([f64; 2]),
    /// Logarithmic axis from the first value to the second; both are positive.
    Logarithmic([f64; 2]),
}

impl Scale {
    /// Creates a linear axis from `low` to `high`, in the unit of the values. It is one unit long around the value if
    /// both are equal. It goes from 0 to 1 if `low` is above `high`, if one of them is NaN, or if both are the same
    /// infinity.
    pub fn linear([low, high]: [f64; 2]) -> Self {
        if low < high {
            Self::Linear([low, high])
        } else if low == high && low.is_finite() {
            Self::Linear([low - 0.5, high + 0.5])
        } else {
            Self::Linear([0.0, 1.0])
        }
    }

    /// Creates a logarithmic axis from `low` to `high`, both positive, in the unit of the values. It goes from half
    /// to twice the value if both are equal, and from 0.1 to 1 if the range is empty, not
    /// positive or not finite.
    pub fn logarithmic([low, high]: [f64; 2]) -> Self {
        if 0.0 < low && low < high && high.is_finite() {
            Self::Logarithmic([low, high])
        } else if low == high && 0.0 < low && low.is_finite() {
            Self::Logarithmic([0.5 * low, 2.0 * high])
        } else {
            Self::Logarithmic([0.1, 1.0])
        }
    }

    /// Returns the smallest and the largest value on the axis.
    pub fn ends(&self) -> [f64; 2] {
        let (Self::Linear(ends) | Self::Counts(ends) | Self::Logarithmic(ends)) = self;
        *ends
    }

    /// Returns the position of `value` along the axis: 0 at the low end, 1 at the high end, outside 0 to 1 beyond
    /// them.
    fn fraction(&self, value: f64) -> f64 {
        match self {
            Self::Linear([low, high]) | Self::Counts([low, high]) => (value - low) / (high - low),
            Self::Logarithmic([low, high]) => (value / low).ln() / (high / low).ln(),
        }
    }

    /// Returns the round numbers to write beside an axis of `length_px`, ascending, about [`PX_PER_NUMBER`] or more
    /// apart. If fewer than two fit at that distance, they may stand twice as close.
    fn numbers(&self, length_px: f64) -> Vec<f64> {
        let most = (length_px / PX_PER_NUMBER).max(2.0);
        let numbers = self.at_most(most);
        if numbers.len() < 2 { self.at_most(2.0 * most) } else { numbers }
    }

    /// Returns the round numbers on the axis, ascending: at most about `most` + 1 of them on a linear axis. An axis of
    /// counts keeps the whole numbers only. A logarithmic axis may have more (see `round_logarithms`).
    fn at_most(&self, most: f64) -> Vec<f64> {
        match self {
            Self::Linear([low, high]) => round_numbers(*low, *high, most),
            Self::Counts([low, high]) => {
                let mut numbers = round_numbers(*low, *high, most);
                numbers.retain(|v| v.fract() == 0.0);
                numbers
            }
            Self::Logarithmic([low, high]) => round_logarithms(*low, *high, most),
        }
    }
}

/// Returns the smallest and the largest of the finite `values`; [infinity, -infinity] if none is finite.
pub fn range(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let finite = values.into_iter().filter(|v| v.is_finite());
    finite.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
}

/// Writes a number for an axis: as a decimal if it is 0 or its magnitude is at least 0.001 and below 100000, otherwise
/// with an exponent.
fn short(value: f64) -> String {
    if value == 0.0 || (1e-3..1e5).contains(&value.abs()) {
        significant(value, AXIS_DIGITS)
    } else {
        format!("{value:e}")
    }
}

/// A plot and its position in the picture: a rectangle with an axis along x and one along y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Left edge of the rectangle, from the left edge of the picture, px.
    pub left: f64,
    /// Upper edge of the rectangle, from the upper edge of the picture, px.
    pub top: f64,
    /// Width of the rectangle without margins, px.
    pub width: f64,
    /// Height of the rectangle without margins, px.
    pub height: f64,
    /// Range and rule of the horizontal axis; its values ascend to the right.
    pub x: Scale,
    /// Range and rule of the vertical axis; its values ascend upwards.
    pub y: Scale,
    /// Margins for numbers and titles, px: left of the rectangle, above, to the right and below.
    pub margin_px: [f64; 4],
}

impl Frame {
    /// Creates a frame of `size_px` ([width, height] without margins). The upper left corner of its margin is at
    /// `corner`, px of the picture; `margin_px` is left, top, right, bottom.
    pub fn new(
        corner: [f64; 2],
        size_px: [f64; 2],
        margin_px: [f64; 4],
        [x, y]: [Scale; 2],
    ) -> Self {
        let [left, top, ..] = margin_px;
        let [width, height] = size_px;
        Self { left: corner[0] + left, top: corner[1] + top, width, height, x, y, margin_px }
    }

    /// Returns the position in the picture, px from its upper left corner, of the point [x, y], given in the units of
    /// the axes.
    pub fn px(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [
            self.left + self.x.fraction(x) * self.width,
            self.top + (1.0 - self.y.fraction(y)) * self.height,
        ]
    }

    /// Returns the lower edge of the rectangle, px from the upper edge of the picture.
    pub fn bottom(&self) -> f64 {
        self.top + self.height
    }

    /// Returns the right edge of the rectangle, px from the left edge of the picture.
    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    /// Draws the rectangle of the frame, tick marks and numbers at its left and lower edge, and the titles of both
    /// axes.
    pub fn axes(&self, svg: &mut Svg, [x_title, y_title]: [&str; 2]) {
        let left = self.left;
        let bottom = self.bottom();
        let font = svg.font_px();
        let edge = format!("fill=\"none\" stroke=\"{INK}\"");
        let mark = format!("stroke=\"{INK}\"");
        svg.rectangle([left, self.top], [self.width, self.height], &edge);
        for v in self.x.numbers(self.width) {
            let x = self.px([v, self.y.ends()[0]])[0];
            svg.path(&mark, &format!("M{x:.1} {bottom:.1}v{MARK_PX}"));
            svg.text([x, bottom + MARK_PX + font], MIDDLE, &short(v));
        }
        for v in self.y.numbers(self.height) {
            let y = self.px([self.x.ends()[0], v])[1];
            svg.path(&mark, &format!("M{left:.1} {y:.1}h-{MARK_PX}"));
            let beside = [left - MARK_PX - 3.0, y + 0.36 * font];
            svg.text(beside, END, &short(v));
        }
        let [margin_left, _, _, margin_below] = self.margin_px;
        svg.text([left + 0.5 * self.width, bottom + margin_below - 12.0], MIDDLE, x_title);
        let beside = [left - margin_left + font + 4.0, self.top + 0.5 * self.height];
        svg.upward_text(beside, y_title);
    }

    /// Draws a grey line across the frame at each number of the two axes.
    pub fn grid(&self, svg: &mut Svg) {
        let mut d = String::new();
        for v in self.x.numbers(self.width) {
            let x = self.px([v, self.y.ends()[0]])[0];
            put(&mut d, format_args!("M{x:.1} {:.1}v{:.1}", self.top, self.height));
        }
        for v in self.y.numbers(self.height) {
            let y = self.px([self.x.ends()[0], v])[1];
            put(&mut d, format_args!("M{:.1} {y:.1}h{:.1}", self.left, self.width));
        }
        svg.path("stroke=\"#dddddd\"", &d);
    }

    /// Writes the title `words` above the frame, at its left edge; nothing if `words` is empty.
    pub fn title(&self, svg: &mut Svg, words: &str) {
        if !words.is_empty() {
            svg.text([self.left, self.top - 10.0], "", words);
        }
    }

    /// Writes `words` as a note in small print at the right, below the title of the x axis; nothing if `words` is
    /// empty. The descenders of its letters end above the lower edge of the picture.
    pub fn note(&self, svg: &mut Svg, words: &str) {
        if !words.is_empty() {
            let [_, _, margin_right, margin_below] = self.margin_px;
            let end =
                [self.right() + margin_right - 6.0, self.bottom() + margin_below - NOTE_DESCENT_PX];
            svg.text(end, &format!("{END} font-size=\"11\" fill=\"#444444\""), words);
        }
    }

    /// Draws a line of `colour` (`#rrggbb`) through `points`, each [x, y] in the units of the axes. A point with a
    /// NaN interrupts the line.
    pub fn curve(&self, svg: &mut Svg, points: impl IntoIterator<Item = [f64; 2]>, colour: &str) {
        let mut d = String::new();
        let mut letter = 'M';
        for point in points {
            let [x, y] = self.px(point);
            if x.is_nan() || y.is_nan() {
                letter = 'M';
                continue;
            }
            put(&mut d, format_args!("{letter}{x:.1} {y:.1}"));
            letter = 'L';
        }
        svg.path(&format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\""), &d);
    }

    /// Draws a vertical line over the height of the frame at the value `x`, in the unit of the x axis. `style` holds
    /// the SVG attributes of the line.
    pub fn upright(&self, svg: &mut Svg, x: f64, style: &str) {
        let x = self.px([x, self.y.ends()[0]])[0];
        svg.path(style, &format!("M{x:.1} {:.1}v{:.1}", self.top, self.height));
    }

    /// Writes a legend above the frame, at the right: for each (name, colour) a dash in the colour (`#rrggbb`), and
    /// the name.
    pub fn legend(&self, svg: &mut Svg, entries: &[(&str, &str)]) {
        let mut words = String::new();
        for (name, colour) in entries {
            put(
                &mut words,
                format_args!(
                    "<tspan dx=\"14\" fill=\"{colour}\" font-weight=\"bold\">\u{2014} </tspan>\
                     <tspan>{}</tspan>",
                    escaped(name)
                ),
            );
        }
        svg.put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" {END} font-size=\"12\">{words}</text>",
            self.right(),
            self.top - 10.0
        ));
    }

    /// Draws a colour bar to the right of the frame: the colours of `bands`, the finite ends of their range as numbers,
    /// and their `unit`.
    pub fn colour_bar(&self, svg: &mut Svg, bands: &Bands, unit: &str) {
        let height = self.height.max(LEAST_BAR_PX);
        let left = self.right() + BAR_PX[0];
        let bottom = self.top + height;
        let step = height / bands.colours().len() as f64;
        for (k, colour) in bands.colours().iter().enumerate() {
            // Each rectangle is a little higher than its step, so that no paper shows between two
            // of them.
            let corner = [left, bottom - (k + 1) as f64 * step];
            svg.rectangle(corner, [BAR_PX[1], step + 0.3], &format!("fill=\"{colour}\""));
        }
        let beside = left + BAR_PX[1] + 4.0;
        let ends = bands.range().into_iter().zip([bottom, self.top + 11.0]);
        for (value, y) in ends.filter(|(value, _)| value.is_finite()) {
            svg.text([beside, y], "", &significant(value, BAR_DIGITS));
        }
        svg.upward_text([beside + 12.0, 0.5 * (self.top + bottom)], unit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::colour::{LINES, VIRIDIS};

    fn frame(x: Scale, y: Scale) -> Frame {
        Frame::new([0.0, 0.0], [400.0, 200.0], [60.0, 30.0, 90.0, 50.0], [x, y])
    }

    #[test]
    fn y_goes_up_and_equal_ratios_are_equally_long() {
        let f = frame(Scale::linear([0.0, 10.0]), Scale::logarithmic([0.01, 100.0]));
        assert_eq!(f.px([0.0, 0.01]), [60.0, 230.0]);
        assert_eq!(f.px([10.0, 100.0]), [460.0, 30.0]);
        // Four decades over 200 px.
        let [x, y] = f.px([5.0, 0.1]);
        // Rounding of places of some hundred px.
        assert!((x - 260.0).abs() < 1e-12 && (y - 180.0).abs() < 1e-12);
    }

    #[test]
    fn an_axis_has_two_numbers_and_small_print_stays_in_the_picture() {
        // 140 px have room for two numbers 50 px apart; of the round ones 5e5 apart only 0 is within the ends.
        let numbers = Scale::linear([-383_000.0, 383_000.0]).numbers(140.0);
        assert!(numbers.len() >= 2, "{numbers:?}");
        let f = frame(Scale::linear([0.0, 1.0]), Scale::linear([0.0, 1.0]));
        let mut svg = Svg::new(14.0);
        f.note(&mut svg, "gap");
        let text = svg.finish([550.0, 280.0]);
        let y: f64 =
            text.split(" y=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap();
        // DejaVu Sans descends by 0.236 of its size, here 11 px.
        assert!(y + 0.236 * 11.0 <= 280.0, "{text}");
    }

    #[test]
    fn a_scale_of_one_value_or_none_has_a_length() {
        assert_eq!(Scale::linear([2.0, 2.0]), Scale::Linear([1.5, 2.5]));
        assert_eq!(Scale::linear(range([f64::NAN])), Scale::Linear([0.0, 1.0]));
        assert_eq!(Scale::logarithmic([2.0, 2.0]), Scale::Logarithmic([1.0, 4.0]));
        assert_eq!(Scale::logarithmic([0.0, 2.0]), Scale::Logarithmic([0.1, 1.0]));
        assert_eq!(range([1.0, f64::NAN, -3.0]), [-3.0, 1.0]);
    }

    #[test]
    fn axes_have_round_numbers_at_their_places() {
        let mut svg = Svg::new(14.0);
        frame(Scale::linear([0.0, 92.3]), Scale::logarithmic([0.02, 30.0]))
            .axes(&mut svg, ["x (mm)", "a < b"]);
        let text = svg.finish([550.0, 280.0]);
        // 20 of 92.3 over 400 px from 60.
        assert!(text.contains("d=\"M146.7 230.0v5\"/>\n<text x=\"146.7\" y=\"249.0\""), "{text}");
        for number in [">0<", ">20<", ">80<", ">0.1<", ">1<", ">10<", ">a &lt; b<"] {
            assert_eq!(text.matches(number).count(), 1, "{number} {text}");
        }
    }

    #[test]
    fn what_is_counted_has_whole_numbers() {
        // 300 px have room for halves.
        assert_eq!(Scale::linear([0.0, 2.0]).numbers(300.0), [0.0, 0.5, 1.0, 1.5, 2.0]);
        assert_eq!(Scale::Counts([0.0, 2.0]).numbers(300.0), [0.0, 1.0, 2.0]);
        assert_eq!(Scale::Counts([0.0, 20.0]).numbers(300.0), [0.0, 5.0, 10.0, 15.0, 20.0]);
    }

    #[test]
    fn numbers_at_an_axis_are_short() {
        for (value, words) in [
            (0.0, "0"),
            (-0.25, "-0.25"),
            (1500.0, "1500"),
            (1e-7, "1e-7"),
            (2e5, "2e5"),
            (-1.5e6, "-1.5e6"),
            (0.001, "0.001"),
        ] {
            assert_eq!(short(value), words);
        }
    }

    #[test]
    fn a_curve_is_cut_where_it_is_nan() {
        let mut svg = Svg::new(14.0);
        let f = frame(Scale::linear([0.0, 4.0]), Scale::linear([0.0, 1.0]));
        f.curve(&mut svg, [0.0, 1.0, f64::NAN, 0.5, 1.0].map(|y| [y, y]), INK);
        f.curve(&mut svg, [], INK);
        let text = svg.finish([550.0, 280.0]);
        assert_eq!((text.matches('M').count(), text.matches("<path").count()), (2, 1), "{text}");
    }

    #[test]
    fn a_legend_has_every_name_and_no_markup_of_it() {
        let mut svg = Svg::new(14.0);
        let f = frame(Scale::linear([0.0, 1.0]), Scale::linear([0.0, 1.0]));
        f.legend(&mut svg, &[("before", INK), ("a<b", LINES[0])]);
        let text = svg.finish([550.0, 280.0]);
        assert!(text.contains("<text x=\"460.0\" y=\"20.0\""), "{text}");
        assert!(text.contains("<tspan>before</tspan>") && text.contains("<tspan>a&lt;b</tspan>"));
        assert_eq!(text.matches(&format!("fill=\"{}\"", LINES[0])).count(), 1);
    }

    #[test]
    fn a_bar_of_colours_has_all_bands_and_the_ends_of_the_range() {
        let mut svg = Svg::new(14.0);
        let f = frame(Scale::linear([0.0, 1.0]), Scale::linear([0.0, 1.0]));
        f.colour_bar(&mut svg, &Bands::new(&VIRIDIS, 24, [-1.23456, 2.0]), "nm");
        let text = svg.finish([550.0, 280.0]);
        assert_eq!(text.matches("width=\"12.00\"").count(), 24);
        assert!(text.contains(">-1.235<") && text.contains(">2<") && text.contains(">nm<"));
    }
}
