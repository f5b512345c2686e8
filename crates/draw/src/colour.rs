//! Colours on white paper that people with a colour vision deficiency can tell apart.

/// Colour map for filled areas such as the pixels of a map, from the smallest value to the largest: viridis,
/// ascending in lightness (S. van der Walt, N. Smith, 2015).
pub const VIRIDIS: [&str; 9] = [
    "#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30",
    "#fde725",
];

/// Colour map for lines and small marks, from the smallest value to the largest. These are the colours of viridis,
/// with a darker light end so that a thin line is visible on white.
pub const VIRIDIS_FOR_LINES: [&str; 8] =
    ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0b020", "#d8a010"];

/// Diverging colour map: blue for values below the middle of the range, white for the middle, brown for values above.
pub const BLUE_TO_BROWN: [&str; 7] =
    ["#053061", "#3a7db8", "#a6cde3", "#f7f7f7", "#f0b573", "#bd6a11", "#5c2f04"];

/// Colours of lines in one plot: the palette of M. Okabe and K. Ito (2008), with a darker yellow.
pub const LINES: [&str; 6] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#b8860b"];

/// Colour of the axes, and of the reference curve that the other curves of a plot are compared with.
pub const INK: &str = "#000000";

/// Returns the colour of the `k`-th curve of a plot, `k` from 0, written `#rrggbb`. The colours repeat after the last
/// of [`LINES`].
pub fn of_line(k: usize) -> &'static str {
    LINES[k % LINES.len()]
}

/// Returns red, green and blue (0 to 255) at `fraction` between the first (0) and the last (1) of `stops`, two or more
/// colours written `#rrggbb`. A fraction outside 0 to 1 gives the colour of the nearer end.
pub fn rgb_at(stops: &[&str], fraction: f64) -> [u8; 3] {
    let position = fraction.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
    let i = (position as usize).min(stops.len() - 2);
    let channel = |stop: &str, k: usize| {
        f64::from(u8::from_str_radix(&stop[1 + 2 * k..3 + 2 * k], 16).unwrap_or(0))
    };
    [0, 1, 2].map(|k| {
        let [a, b] = [stops[i], stops[i + 1]].map(|stop| channel(stop, k));
        (a + (b - a) * (position - i as f64)).round() as u8
    })
}

/// Returns the colour at `fraction` (0 to 1) between the first and the last of two or more `stops`. All colours are
/// written `#rrggbb`.
pub fn hex_at(stops: &[&str], fraction: f64) -> String {
    let [r, g, b] = rgb_at(stops, fraction);
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// A range of values that is divided into bands of equal width. All values in a band have the same colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Bands {
    range: [f64; 2],
    colours: Vec<String>,
}

impl Bands {
    /// Divides `range` ([smallest, largest value]) into `count` bands. Their colours run from the first to the last
    /// of `stops`, each stop written `#rrggbb`.
    pub fn new(stops: &[&str], count: usize, range: [f64; 2]) -> Self {
        let middles = (0..count).map(|k| (k as f64 + 0.5) / count as f64);
        Self { range, colours: middles.map(|middle| hex_at(stops, middle)).collect() }
    }

    /// Returns the index of the band that contains `value`, from 0. It is the first or the last band if the value is
    /// outside the range, and the first band for NaN. If the range is a single value, it is always the middle band.
    pub fn index(&self, value: f64) -> usize {
        let [low, high] = self.range;
        let fraction = if high > low { (value - low) / (high - low) } else { 0.5 };
        ((fraction * self.colours.len() as f64).max(0.0) as usize).min(self.colours.len() - 1)
    }

    /// Returns the colours of the bands as `#rrggbb`, that of the smallest values first.
    pub fn colours(&self) -> &[String] {
        &self.colours
    }

    /// Returns the smallest and the largest value of the range.
    pub fn range(&self) -> [f64; 2] {
        self.range
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_begin_and_end_as_given() {
        assert_eq!(hex_at(&BLUE_TO_BROWN, 0.0), BLUE_TO_BROWN[0]);
        assert_eq!(hex_at(&BLUE_TO_BROWN, 0.5), BLUE_TO_BROWN[3]);
        assert_eq!(hex_at(&VIRIDIS_FOR_LINES, 7.0), VIRIDIS_FOR_LINES[7]);
        assert_eq!(hex_at(&["#000000", "#ff8000"], 0.5), "#804000");
    }

    #[test]
    fn viridis_gets_lighter() {
        // Luma of Rec. 601, roughly: 3 red, 6 green, 1 blue.
        let light = |k: usize| {
            let [r, g, b] = rgb_at(&VIRIDIS, k as f64 / 47.0).map(u32::from);
            3 * r + 6 * g + b
        };
        assert!((1..48).all(|k| light(k) > light(k - 1)));
    }

    #[test]
    fn every_value_has_a_band() {
        let bands = Bands::new(&VIRIDIS, 4, [-1.0, 1.0]);
        let found = [-9.0, -1.0, -0.51, -0.49, 0.0, 0.99, 1.0, 9.0].map(|v| bands.index(v));
        assert_eq!(found, [0, 0, 0, 1, 2, 3, 3, 3]);
        assert_eq!(Bands::new(&VIRIDIS, 5, [3.0, 3.0]).index(3.0), 2);
        assert_eq!(bands.colours().len(), 4);
    }
}
