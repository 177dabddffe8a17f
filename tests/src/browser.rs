//! A headless browser over WebDriver (W3C), and requests as a program sends them. Both speak to this machine alone.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::install;

/// How long a page or an answer may take before a test fails.
const PATIENCE: Duration = Duration::from_secs(30);

/// An answer of a server.
#[derive(Debug)]
pub struct Answer {
    /// Status.
    pub status: u16,
    /// Status line and headers.
    pub head: String,
    /// Body.
    pub body: String,
}

/// Whether an answer has come to the end that its length states.
fn is_whole(answer: &[u8]) -> bool {
    let Some(end) = answer.windows(4).position(|four| four == b"\r\n\r\n") else { return false };
    let head = String::from_utf8_lossy(&answer[..end]).to_ascii_lowercase();
    let length = head.lines().find_map(|line| line.strip_prefix("content-length:")?.trim().parse::<usize>().ok());
    length.is_some_and(|length| answer.len() >= end + 4 + length)
}

/// Sends bytes to a port of this machine and reads the answer, or until the connection is closed.
///
/// # Errors
/// The connection breaks.
pub fn send(port: u16, bytes: &[u8]) -> std::io::Result<Answer> {
    let mut stream = TcpStream::connect(("127.0.0.1", port))?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.write_all(bytes)?;
    let (mut all, mut chunk) = (Vec::new(), [0; 1 << 16]);
    // A server may keep the connection open.
    while !is_whole(&all) {
        match stream.read(&mut chunk)? {
            0 => break,
            n => all.extend_from_slice(&chunk[..n]),
        }
    }
    let text = String::from_utf8_lossy(&all).into_owned();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    let body = if head.to_ascii_lowercase().contains("transfer-encoding: chunked") {
        unchunked(body)
    } else {
        body.to_owned()
    };
    Ok(Answer { status, head: head.to_owned(), body })
}

fn unchunked(body: &str) -> String {
    let (mut rest, mut all) = (body, String::new());
    while let Some((size, after)) = rest.split_once("\r\n") {
        let size = usize::from_str_radix(size.trim(), 16).unwrap_or(0);
        match after.get(..size).filter(|_| size > 0) {
            Some(chunk) => all += chunk,
            None => break,
        }
        rest = after[size..].trim_start_matches("\r\n");
    }
    all
}

/// A request with a body, its headers besides the host and the length.
///
/// # Panics
/// The server does not answer.
#[must_use]
pub fn request(port: u16, method: &str, path: &str, headers: &str, body: &str) -> Answer {
    let host = if headers.to_ascii_lowercase().contains("host:") {
        String::new()
    } else {
        format!("Host: 127.0.0.1:{port}\r\n")
    };
    let length = body.len();
    let text = format!(
        "{method} {path} HTTP/1.1\r\n{host}Connection: close\r\nContent-Length: {length}\r\n{headers}\r\n{body}"
    );
    send(port, text.as_bytes()).unwrap_or_else(|e| panic!("{method} {path}: {e}"))
}

/// A page.
///
/// # Panics
/// The server does not answer.
#[must_use]
pub fn get(port: u16, path: &str) -> Answer {
    request(port, "GET", path, "", "")
}

/// A child that ends with its owner.
pub struct Ended(pub Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A browser with one window.
pub struct Browser {
    driver: Option<Ended>,
    port: u16,
    session: String,
    _profile: tempfile::TempDir,
}

/// The browser that this test drives, or its driver; installed where there is none.
fn program(name: &str) -> PathBuf {
    installed(name).unwrap_or_else(|| {
        let said = install(&["chromium", "chromedriver"], &["chromium", "chromium-driver", "fonts-dejavu-core"]);
        installed(name).unwrap_or_else(|| {
            let error = String::from_utf8_lossy(&said.stderr);
            panic!("there is no {name}, and tests/install.sh did not install it: {error}")
        })
    })
}

fn installed(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).map(|folder| folder.join(name)).find(|program| program.is_file())
}

impl Browser {
    /// Starts Chromium with a window of this width and height.
    ///
    /// # Panics
    /// There is no browser, or it does not start.
    #[must_use]
    pub fn start(width: u32, height: u32, dark: bool) -> Self {
        let profile = tempfile::tempdir().expect("a temporary folder");
        let port = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port").port();
        let mut driver = Command::new(program("chromedriver"));
        driver.arg(format!("--port={port}")).env("HOME", profile.path());
        let driver = driver.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("chromedriver starts");
        let driver = Some(Ended(driver));
        let mut flags: Vec<String> = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
        ]
        .map(str::to_owned)
        .to_vec();
        flags.push(format!("--user-data-dir={}", profile.path().join("profile").display()));
        flags.push(format!("--window-size={width},{height}"));
        let options = json!({ "binary": program("chromium"), "args": flags });
        let wanted = json!({ "browserName": "chrome", "goog:chromeOptions": options, "goog:loggingPrefs": {
            "browser": "ALL" } });
        let body = json!({ "capabilities": { "alwaysMatch": wanted } }).to_string();
        let begun = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(begun.elapsed() < PATIENCE, "chromedriver does not answer");
            std::thread::sleep(Duration::from_millis(50));
        }
        let answer = request(port, "POST", "/session", "Content-Type: application/json\r\n", &body);
        let value: Value = serde_json::from_str(&answer.body).unwrap_or_else(|e| panic!("{e}: {answer:?}"));
        let session =
            value["value"]["sessionId"].as_str().unwrap_or_else(|| panic!("no browser: {value:#}")).to_owned();
        let browser = Self { driver, port, session, _profile: profile };
        // The window may not be narrower than its frame lets it be: the page's width is set apart.
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        browser.devtools("Emulation.setDeviceMetricsOverride", &metrics);
        let scheme = if dark { "dark" } else { "light" };
        let media = json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] });
        browser.devtools("Emulation.setEmulatedMedia", &media);
        browser
    }

    fn command(&self, method: &str, path: &str, body: &Value) -> Value {
        let path = format!("/session/{}{path}", self.session);
        let body = if method == "GET" { String::new() } else { body.to_string() };
        let answer = request(self.port, method, &path, "Content-Type: application/json\r\n", &body);
        let mut value: Value = serde_json::from_str(&answer.body).unwrap_or_else(|e| panic!("{path}: {e}: {answer:?}"));
        assert_eq!(answer.status, 200, "{path}: {value:#}");
        value["value"].take()
    }

    fn devtools(&self, name: &str, parameters: &Value) -> Value {
        self.command("POST", "/goog/cdp/execute", &json!({ "cmd": name, "params": parameters }))
    }

    /// Opens an address.
    pub fn open(&self, address: &str) {
        let _ = self.command("POST", "/url", &json!({ "url": address }));
    }

    /// Runs a script in the page and gives what it returns.
    pub fn run(&self, script: &str) -> Value {
        self.command("POST", "/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// The same of a script that calls its last argument with the result.
    pub fn run_async(&self, script: &str) -> Value {
        self.command("POST", "/execute/async", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script returns what is true.
    ///
    /// # Panics
    /// It does not within half a minute.
    pub fn wait_for(&self, script: &str) {
        self.wait_for_within(script, PATIENCE);
    }

    /// The same with another patience: what is waited for is computed.
    ///
    /// # Panics
    /// It does not come within that time.
    pub fn wait_for_within(&self, script: &str, patience: Duration) {
        let begun = Instant::now();
        while self.run(&format!("return Boolean({script})")) != true {
            assert!(begun.elapsed() < patience, "never true: {script}\n{}", self.run("return document.body.innerText"));
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn element(&self, selector: &str) -> String {
        let found = self.command("POST", "/element", &json!({ "using": "css selector", "value": selector }));
        let id = found.as_object().and_then(|o| o.values().next()).and_then(Value::as_str);
        id.unwrap_or_else(|| panic!("no {selector}: {found}")).to_owned()
    }

    /// Clicks as a hand does: where the element is, if nothing covers it.
    pub fn click(&self, selector: &str) {
        let id = self.element(selector);
        let _ = self.command("POST", &format!("/element/{id}/click"), &json!({}));
    }

    /// Types into an element.
    pub fn write(&self, selector: &str, text: &str) {
        let id = self.element(selector);
        let _ = self.command("POST", &format!("/element/{id}/value"), &json!({ "text": text }));
    }

    /// Presses a key, WebDriver's code for one that has no letter, wherever the focus is.
    pub fn press(&self, key: &str) {
        let actions = json!([{ "type": "key", "id": "keys", "actions": [
            { "type": "keyDown", "value": key }, { "type": "keyUp", "value": key }
        ] }]);
        let _ = self.command("POST", "/actions", &json!({ "actions": actions }));
    }

    /// What the console holds since the last call.
    pub fn console(&self) -> Vec<String> {
        let log = self.command("POST", "/se/log", &json!({ "type": "browser" }));
        log.as_array().into_iter().flatten().map(ToString::to_string).collect()
    }

    /// The whole page as PNG.
    ///
    /// # Panics
    /// The file cannot be written.
    pub fn picture(&self, path: &Path) {
        let size = self.run("return [document.documentElement.scrollWidth, document.documentElement.scrollHeight]");
        let clip = json!({ "x": 0, "y": 0, "width": size[0], "height": size[1].as_f64().unwrap_or(0.0).min(6000.0),
            "scale": 1 });
        let shot = json!({ "format": "png", "captureBeyondViewport": true, "clip": clip });
        let data = self.devtools("Page.captureScreenshot", &shot);
        std::fs::write(path, unbase64(data["data"].as_str().unwrap_or_default())).expect("writable");
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let path = format!("/session/{}", self.session);
        let text = format!("DELETE {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n");
        let _ = send(self.port, text.as_bytes());
        drop(self.driver.take());
    }
}

/// Bytes of base64 (RFC 4648).
fn unbase64(text: &str) -> Vec<u8> {
    let digit = |b: u8| match b {
        b'A'..=b'Z' => b - b'A',
        b'a'..=b'z' => b - b'a' + 26,
        b'0'..=b'9' => b - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = text.bytes().filter(|b| *b != b'=').map(digit).collect();
    let bytes = digits.chunks(4).flat_map(|chunk| {
        let bits = chunk.iter().fold(0_u32, |sum, d| sum << 6 | u32::from(*d)) << (6 * (4 - chunk.len()));
        bits.to_be_bytes()[1..chunk.len().max(1)].to_vec()
    });
    bytes.collect()
}
