//! Text for people and other programs. Names may contain any character that a file system allows,
//! and numbers may be any result of arithmetic.

use std::borrow::Cow;

/// Returns `text` in a form that is safe in a line of a terminal or a cell of a table. Characters that could command
/// the terminal, end the line or turn the reading direction are escaped (`\u{1b}`, `\n`).
pub fn visible(text: &str) -> Cow<'_, str> {
    if !text.chars().any(is_invisible) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if is_invisible(c) {
            out.extend(c.escape_default());
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

/// Returns true for control characters, line separators, direction marks, and characters that XML
/// 1.0 cannot represent.
fn is_invisible(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}')
        || matches!(c, '\u{2066}'..='\u{2069}' | '\u{feff}' | '\u{fffe}' | '\u{ffff}')
}

/// Returns `text` for the inside of an element or a quoted attribute of XML or HTML.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in visible(text).chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

/// Returns `value` as text with `decimals` decimals. Zero has no sign; a value that is not finite is a dash.
pub fn fixed(value: f64, decimals: usize) -> String {
    if !value.is_finite() {
        return "-".into();
    }
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(size) if size.bytes().all(|b| b == b'0' || b == b'.') => size.into(),
        _ => text,
    }
}

/// Returns `value` as text with `digits` significant digits and without trailing zeros. Values from 1e-4 to 1e6 have no
/// exponent; a value that is not finite is a dash.
pub fn significant(value: f64, digits: usize) -> String {
    if !value.is_finite() {
        return "-".into();
    }
    if value == 0.0 {
        return "0".into();
    }
    let rounded = format!("{value:.*e}", digits.max(1) - 1);
    let (mantissa, exponent) = rounded.split_once('e').unwrap_or((&rounded, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if !(-4..6).contains(&exponent) {
        return format!("{}e{exponent}", without_trailing_zeros(mantissa));
    }
    let decimals = usize::try_from(digits as i32 - 1 - exponent).unwrap_or(0);
    without_trailing_zeros(&format!("{value:.decimals$}")).into()
}

/// Returns the text of a number without the zeros at the end of its decimals.
fn without_trailing_zeros(number: &str) -> &str {
    if !number.contains('.') {
        return number;
    }
    number.trim_end_matches('0').trim_end_matches('.')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_commands_a_terminal_is_spelt_out() {
        assert_eq!(visible("plain, Zürich"), "plain, Zürich");
        assert!(matches!(visible("plain"), Cow::Borrowed(_)));
        assert_eq!(visible("a\u{1b}[31mred\n\t\u{7f}\u{9b}"), r"a\u{1b}[31mred\n\t\u{7f}\u{9b}");
        // Right-to-left override, separators of lines, a byte order mark.
        assert_eq!(
            visible("\u{202e}\u{2028}\u{2066}\u{feff}"),
            r"\u{202e}\u{2028}\u{2066}\u{feff}"
        );
    }

    #[test]
    fn markup_is_text_once() {
        assert_eq!(escaped("a<b & \"c\"'>"), "a&lt;b &amp; &quot;c&quot;&#39;&gt;");
        assert_eq!(escaped("&lt;"), "&amp;lt;");
        assert_eq!(escaped("\u{0}\u{8}\u{ffff}"), r"\u{0}\u{8}\u{ffff}");
    }

    #[test]
    fn numbers_have_no_sign_of_zero_and_no_needless_exponent() {
        for (value, decimals, text) in [
            (-0.0, 4, "0.0000"),
            (-4e-8, 4, "0.0000"),
            (-0.5, 0, "0"),
            (-0.00006, 4, "-0.0001"),
            (12.345, 2, "12.35"),
            (f64::NAN, 2, "-"),
            (f64::NEG_INFINITY, 2, "-"),
        ] {
            assert_eq!(fixed(value, decimals), text, "{value}");
        }
        for (value, text) in [
            (0.99, "0.99"),
            (0.199_999_994_947_575_03, "0.2"),
            (-0.0, "0"),
            (999_999.7, "1e6"),
            (123_456.0, "123456"),
            (-1.5e-7, "-1.5e-7"),
            (1e-4, "0.0001"),
            (1500.0, "1500"),
            (f64::NAN, "-"),
        ] {
            assert_eq!(significant(value, 6), text, "{value}");
        }
    }
}
