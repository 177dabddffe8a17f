//! What all pages share: head, menu, foot, numbers, and where links lead.

use dragfree_workflow::words::{measured, quoted, readable_unit};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde::Serialize;

/// Where links lead: to pages of a server, or to files of a report, which has the pages of one product.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Links {
    /// A server.
    Server {
        /// Whether pages may change something.
        changes: bool,
    },
    /// Files beside each other, of this product.
    Files {
        /// Its id.
        id: String,
    },
}

impl Links {
    /// Whether the page is a file.
    pub(crate) fn is_file(&self) -> bool {
        matches!(self, Self::Files { .. })
    }

    /// Whether pages may change something.
    pub(crate) fn allows_changes(&self) -> bool {
        matches!(self, Self::Server { changes: true })
    }

    fn asset(&self, name: &str) -> String {
        let above = if self.is_file() { "" } else { "/" };
        format!("{above}assets/{name}")
    }

    /// The page of a product; none where a report does not have it.
    pub(crate) fn of(&self, kind: &str, product: &str) -> Option<String> {
        match self {
            Self::Server { .. } => Some(format!("/{kind}/{product}")),
            Self::Files { id } if id == product && kind == "day" => Some("index.html".to_owned()),
            Self::Files { id } if id == product => Some(format!("{kind}.html")),
            Self::Files { .. } => None,
        }
    }

    /// The page on missing physics of a product.
    pub(crate) fn missing(&self, product: &str) -> Option<String> {
        match self {
            Self::Server { .. } => Some(format!("/missing?products={product}")),
            Self::Files { id } if id == product => Some("missing.html".to_owned()),
            Self::Files { .. } => None,
        }
    }

    fn menu(&self) -> Vec<(&'static str, String)> {
        match self {
            Self::Server { .. } => [
                ("Mission", "/"),
                ("Trends", "/trends"),
                ("Compare", "/compare"),
                ("Missing physics", "/missing"),
                ("Plugins", "/plugins"),
            ]
            .map(|(name, to)| (name, to.to_owned()))
            .to_vec(),
            Self::Files { .. } => {
                [("Day", "index.html"), ("Compare", "compare.html"), ("Missing physics", "missing.html")]
                    .map(|(name, to)| (name, to.to_owned()))
                    .to_vec()
            }
        }
    }
}

/// A page. `lead` is the sentence that says what to do with it.
pub(crate) fn page(links: &Links, active: &str, title: &str, lead: &str, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) " · dragfree" }
                link rel="icon" href="data:,";
                link rel="stylesheet" href=(links.asset("uPlot.min.css"));
                link rel="stylesheet" href=(links.asset("bench.css"));
                script defer src=(links.asset("uPlot.iife.min.js")) {}
                script defer src=(links.asset("bench.js")) {}
            }
            body {
                a class="skip" href="#main" { "To the content" }
                header {
                    span class="brand" { "dragfree" }
                    nav aria-label="Pages" {
                        @for (name, to) in links.menu() {
                            a href=(to) aria-current=[(name == active).then_some("page")] { (name) }
                        }
                    }
                }
                main id="main" {
                    h1 { (title) }
                    p class="lead" { (lead) }
                    (body)
                }
            }
        }
    }
}

/// A command that does what the page does.
pub(crate) fn command(words: &str) -> Markup {
    html! { pre class="command" tabindex="0" { code { (words) } } }
}

/// A word as a shell takes it.
pub(crate) fn shell(word: &str) -> String {
    quoted(word)
}

/// A value with its σ in the unit that people read.
pub(crate) fn value(value: f64, sigma: f64, unit: &str) -> String {
    let (unit, factor) = readable_unit(unit);
    format!("{} {unit}", measured(value * factor, sigma * factor)).trim_end().to_owned()
}

/// A length in millimetres with its sign.
pub(crate) fn millimetres(value_m: f64) -> String {
    format!("{:+.2} mm", 1e3 * value_m).replace('-', "−")
}

/// A true error with its size in σ.
pub(crate) fn error(error_m: f64, sigma_m: f64) -> String {
    format!("{}, {:.1} σ", millimetres(error_m), (error_m / sigma_m).abs())
}

/// Data for the script of a page. `<` is written so that no text of the data can end the element.
pub(crate) fn data(id: &str, value: &impl Serialize) -> Markup {
    let text = serde_json::to_string(value).unwrap_or_default().replace('<', "\\u003c");
    html! { script type="application/json" id=(id) { (PreEscaped(text)) } }
}

/// A picture of the chart crate inside a page: what an SVG file begins with has no place there.
pub(crate) fn picture(svg: &str, label: &str) -> Markup {
    let inner = svg.find("<svg").map_or(svg, |at| &svg[at..]);
    html! { div class="picture" role="img" aria-label=(label) tabindex="0" { (PreEscaped(inner)) } }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_of_the_data_cannot_leave_its_element() {
        let text = data("x", &"</script><script>alert(1)</script>").into_string();
        assert_eq!(text.matches("</script>").count(), 1, "{text}");
        let back: String = serde_json::from_str(
            &text[text.find('"').map_or(0, |_| text.find(">\"").unwrap_or(0) + 1)..text.rfind("</").unwrap_or(0)],
        )
        .expect("JSON");
        assert_eq!(back, "</script><script>alert(1)</script>");
    }
}
