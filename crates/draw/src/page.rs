//! One HTML page: its head, and the style that all pages of Planish share.
//!
//! A page is one file. It loads nothing from elsewhere.

use planish_types::text::escaped;

/// Shared style sheet (CSS) of texts, tables and pictures, for the light and the dark colour scheme of the browser.
const STYLE: &str = include_str!("page.css");

/// Content security policy of a page without scripts: the browser loads nothing and runs nothing.
pub const WITHOUT_PROGRAM: &str = "default-src 'none'; style-src 'unsafe-inline'";

/// Returns the shared style sheet, followed by `own`, the CSS rules of one page.
pub fn style(own: &str) -> String {
    format!("{STYLE}{own}")
}

/// Returns a complete HTML document. `title` is plain text, `policy` its content security policy, `style` comes from
/// [`style`], and `body` is HTML.
pub fn document(title: &str, policy: &str, style: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n\
         <title>Planish: {title}</title>\n<style>{style}</style>\n</head>\n<body>\n{body}</body>\n</html>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_title_is_no_element() {
        let page =
            document("<b> & co", WITHOUT_PROGRAM, &style("p { margin: 0; }\n"), "<p>text</p>\n");
        assert!(page.contains("<title>Planish: &lt;b&gt; &amp; co</title>"), "{page}");
        assert!(page.ends_with("<body>\n<p>text</p>\n</body>\n</html>\n"), "{page}");
        assert!(page.contains("p { margin: 0; }\n</style>"), "{page}");
    }
}
