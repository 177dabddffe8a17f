//! Who may ask: the token, the origin and the name under which a server is asked.

use axum::http::{HeaderMap, header};
use rand::TryRng as _;
use rand::rngs::SysRng;

use crate::PagesError;

/// Header with the token of a request that changes something.
const TOKEN: &str = "x-dragfree-token";

/// What a request has to show.
pub(crate) struct Guard {
    token: String,
    /// Port of the server.
    port: u16,
    /// Whether it is reached from this machine alone. If not, reading needs the token too.
    pub(crate) loopback: bool,
    /// Whether anything may be changed.
    pub(crate) changes: bool,
}

impl Guard {
    pub(crate) fn new(port: u16, loopback: bool, changes: bool) -> Result<Self, PagesError> {
        let mut bytes = [0_u8; 16];
        SysRng.try_fill_bytes(&mut bytes).map_err(|e| PagesError::Token(e.to_string()))?;
        let token = bytes.iter().map(|b| format!("{b:02x}")).collect();
        Ok(Self { token, port, loopback, changes })
    }

    pub(crate) fn token(&self) -> &str {
        &self.token
    }

    /// Whether a page may be read. On this machine the name in the request must be of this machine: a foreign page can
    /// let its own name point here, and would then read the answer.
    pub(crate) fn may_read(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        // A foreign page cannot read the answer, but can make this server work; a link in it may lead here.
        let foreign = text(headers, "sec-fetch-site") == "cross-site";
        if foreign && text(headers, "sec-fetch-mode") != "navigate" {
            return Err(Refusal::ForeignPage);
        }
        if self.loopback {
            let host = text(headers, header::HOST.as_str());
            let names = ["127.0.0.1", "localhost", "[::1]"].map(|name| format!("{name}:{}", self.port));
            return if names.iter().any(|name| name == host) { Ok(()) } else { Err(Refusal::Host) };
        }
        let basic = text(headers, header::AUTHORIZATION.as_str()).strip_prefix("Basic ").and_then(decoded);
        let word = basic.as_deref().and_then(|pair| pair.split_once(':')).map(|(_, word)| word);
        if word.is_some_and(|word| self.is_token(word)) { Ok(()) } else { Err(Refusal::NoToken) }
    }

    /// Whether something may be changed: by a page of this server alone, and with the token.
    pub(crate) fn may_change(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        self.may_read(headers)?;
        let host = text(headers, header::HOST.as_str());
        let origin = text(headers, header::ORIGIN.as_str());
        let own = ["http://", "https://"].iter().any(|scheme| origin.strip_prefix(scheme) == Some(host));
        let json = text(headers, header::CONTENT_TYPE.as_str()).starts_with("application/json");
        match () {
            () if !self.changes => Err(Refusal::ReadOnly),
            () if !own || !json => Err(Refusal::Origin),
            () if !self.is_token(text(headers, TOKEN)) => Err(Refusal::Token),
            () => Ok(()),
        }
    }

    /// In a time that does not tell how much of it is right.
    fn is_token(&self, word: &str) -> bool {
        let differs = |sum: u8, (a, b): (u8, u8)| sum | (a ^ b);
        word.len() == self.token.len() && word.bytes().zip(self.token.bytes()).fold(0, differs) == 0
    }
}

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    ForeignPage,
    Host,
    NoToken,
    ReadOnly,
    Origin,
    Token,
}

impl Refusal {
    pub(crate) fn words(self) -> &'static str {
        match self {
            Self::ForeignPage => "a page of another server may lead here, and may not ask anything",
            Self::Host => "this server answers to 127.0.0.1 and localhost alone",
            Self::NoToken => "the token is needed as the password; it was printed where the server was started",
            Self::ReadOnly => "this server only reads; start it with --model FILE --allow-changes to keep effects",
            Self::Origin => "only a page of this server may ask for a change",
            Self::Token => "the token is wrong; it was printed where the server was started",
        }
    }
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> &'a str {
    headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default()
}

/// Text of base64 (RFC 4648), as `Authorization: Basic` has it.
fn decoded(word: &str) -> Option<String> {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let (mut bits, mut count, mut bytes) = (0_u32, 0, Vec::new());
    for byte in word.trim_end_matches('=').bytes() {
        let digit = DIGITS.iter().position(|d| *d == byte)?;
        bits = (bits << 6 | u32::try_from(digit).ok()?) & 0xfff;
        count += 6;
        if count >= 8 {
            count -= 8;
            bytes.push(u8::try_from(bits >> count & 0xff).ok()?);
        }
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::{HeaderName, HeaderValue};

    fn headers(pairs: &[(&str, &str)]) -> HeaderMap {
        let of = |(name, value): &(&str, &str)| {
            (name.parse::<HeaderName>().expect("a name"), HeaderValue::from_str(value).expect("a value"))
        };
        pairs.iter().map(of).collect()
    }

    #[test]
    fn base64_is_read() {
        // RFC 4648, 10; RFC 7617, 2.
        for (word, expected) in [("", ""), ("Zg==", "f"), ("Zm9v", "foo"), ("Zm9vYmE=", "fooba")] {
            assert_eq!(decoded(word).as_deref(), Some(expected));
        }
        assert_eq!(decoded("QWxhZGRpbjpvcGVuIHNlc2FtZQ==").as_deref(), Some("Aladdin:open sesame"));
        assert_eq!(decoded("a b"), None);
    }

    #[test]
    fn a_foreign_page_may_lead_here_and_no_more() {
        let guard = Guard::new(80, true, false).expect("a token");
        let of = |site: &str, mode: &str| {
            let all = [("host", "127.0.0.1:80"), ("sec-fetch-site", site), ("sec-fetch-mode", mode)];
            guard.may_read(&headers(&all))
        };
        assert_eq!(of("cross-site", "no-cors"), Err(Refusal::ForeignPage));
        for (site, mode) in [("cross-site", "navigate"), ("same-origin", "cors"), ("none", "navigate")] {
            assert_eq!(of(site, mode), Ok(()), "{site} {mode}");
        }
    }

    #[test]
    fn a_change_needs_host_origin_and_token() {
        let guard = Guard::new(80, true, true).expect("a token");
        let right = [
            ("host", "127.0.0.1:80"),
            ("origin", "http://127.0.0.1:80"),
            ("content-type", "application/json"),
            (TOKEN, guard.token()),
        ];
        assert_eq!(guard.may_change(&headers(&right)), Ok(()));
        for (at, wrong, refusal) in [
            (0, "evil.example:80", Refusal::Host),
            (1, "http://evil.example", Refusal::Origin),
            (1, "null", Refusal::Origin),
            (2, "text/plain", Refusal::Origin),
            (3, "00000000000000000000000000000000", Refusal::Token),
            (3, "", Refusal::Token),
        ] {
            let mut pairs = right;
            pairs[at].1 = wrong;
            assert_eq!(guard.may_change(&headers(&pairs)), Err(refusal), "{wrong}");
            let left: Vec<_> = right.iter().enumerate().filter(|(k, _)| *k != at).map(|(_, pair)| *pair).collect();
            assert!(guard.may_change(&headers(&left)).is_err());
        }
        let reads = Guard { token: guard.token.clone(), changes: false, ..guard };
        assert_eq!(reads.may_change(&headers(&right)), Err(Refusal::ReadOnly));
    }

    #[test]
    fn from_elsewhere_reading_needs_the_token() {
        let guard = Guard { token: "open sesame".to_owned(), port: 80, loopback: false, changes: false };
        let with = |word: &str| guard.may_read(&headers(&[("host", "far:80"), ("authorization", word)]));
        assert_eq!(with("Basic QWxhZGRpbjpvcGVuIHNlc2FtZQ=="), Ok(()));
        assert_eq!(with("Basic QWxhZGRpbjpvcGVuIHNlc2FtZA=="), Err(Refusal::NoToken));
        assert_eq!(with("Bearer x"), Err(Refusal::NoToken));
    }
}
