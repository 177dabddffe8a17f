//! The pages by their addresses, for the server and for a report alike.

use crate::layout::Links;
use crate::site::{Query, Site};
use crate::{PagesError, compare, day, missing, mission, plugins, trends};

impl Site {
    /// A page by its path, `/day/ID`, as HTML.
    ///
    /// # Errors
    /// [`PagesError`]: there is no such page, or what it shows cannot be computed.
    pub fn page(&self, path: &str, query: &Query, links: &Links) -> Result<String, PagesError> {
        let parts: Vec<&str> = path.trim_matches('/').split('/').collect();
        let page = match parts[..] {
            [""] => mission::page(self, query, links),
            ["trends"] => trends::page(self, query, links),
            ["day", id] => day::page(self, id, links),
            ["compare"] => compare::newest(self, links),
            ["compare", id] => compare::page(self, id, links),
            ["missing"] => missing::page(self, query, links),
            ["plugins"] => plugins::page(self, links),
            _ => Err(PagesError::NoPage(path.to_owned())),
        };
        Ok(page?.into_string())
    }

    /// The part of the page on missing physics that the switches change.
    ///
    /// # Errors
    /// [`PagesError`]: the switches cannot be set so.
    pub fn refit_part(&self, query: &Query, links: &Links) -> Result<String, PagesError> {
        Ok(missing::part(self, query, links)?.into_string())
    }
}
