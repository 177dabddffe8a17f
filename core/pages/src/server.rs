//! The pages behind an address.
//!
//! One thread reads and writes; a few others compute. A request whose reader has gone is dropped while it waits for one
//! of them, so that of many overtaken requests only those under way are finished.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::extract::{Path, Query as Asked, Request, State};
use axum::http::{HeaderMap, HeaderName, Method, StatusCode, header};
use axum::response::Response;
use axum::routing::{get, post};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde::de::DeserializeOwned;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use crate::PagesError;
use crate::formula::Typed;
use crate::guard::{Guard, Refusal};
use crate::jobs::Job;
use crate::layout::Links;
use crate::site::{Query, Site};

/// Requests that compute at a time. A run on the same machine keeps its threads.
const WORKING: usize = 2;
/// Connections at a time; others wait.
const CONNECTIONS: usize = 128;
/// Bytes of a body: a change names switches and nothing else.
const BODY: usize = 1 << 16;
/// Time after which a connection ends, whatever it does: a browser opens another.
const LONGEST_CONNECTION: Duration = Duration::from_secs(600);
/// A request must have come by then.
const PATIENCE: Duration = Duration::from_secs(5);

/// How often it is looked whether the process is to end.
const LOOKS_UP: Duration = Duration::from_millis(200);

/// What the pages load. No page asks another server for anything.
pub(crate) const ASSETS: [(&str, &str, &str); 4] = [
    ("uPlot.min.css", "text/css", include_str!("../assets/uPlot.min.css")),
    ("bench.css", "text/css", include_str!("../assets/bench.css")),
    ("uPlot.iife.min.js", "text/javascript", include_str!("../assets/uPlot.iife.min.js")),
    ("bench.js", "text/javascript", include_str!("../assets/bench.js")),
];

struct App {
    site: Arc<Site>,
    guard: Guard,
    working: Arc<Semaphore>,
}

type Shared = State<Arc<App>>;

/// Where the pages are, once they are.
pub struct Ready {
    /// `http://127.0.0.1:7035/`
    pub address: String,
    /// What a change needs, and where it is not this machine, reading too.
    pub token: String,
}

/// Serves the pages until the program is ended, or its jobs are asked to end ([`dragfree_engine::stop`]). Port 0 takes
/// a free one; `ready` is told which.
///
/// # Errors
/// [`PagesError`]: nothing can listen at the address.
pub fn serve(site: Site, at: SocketAddr, changes: bool, ready: impl FnOnce(&Ready)) -> Result<(), PagesError> {
    let refuse = |source| PagesError::Listen { address: at.to_string(), source };
    let mut runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = runtime.enable_io().enable_time().max_blocking_threads(WORKING + 1).build().map_err(refuse)?;
    runtime.block_on(async {
        let listener = TcpListener::bind(at).await.map_err(refuse)?;
        let own = listener.local_addr().map_err(refuse)?;
        let guard = Guard::new(own.port(), own.ip().is_loopback(), changes)?;
        ready(&Ready { address: format!("http://{own}/"), token: guard.token().to_owned() });
        let app = App { site: Arc::new(site), guard, working: Arc::new(Semaphore::new(WORKING)) };
        accept(listener, &router(app)).await;
        Ok(())
    })
}

/// Takes connections until the process is asked to end.
async fn accept(listener: TcpListener, router: &Router) {
    let connections = Arc::new(Semaphore::new(CONNECTIONS));
    let asked_to_end = dragfree_engine::stop::flag();
    while !asked_to_end.load(Ordering::Relaxed) {
        let permit = tokio::time::timeout(LOOKS_UP, Arc::clone(&connections).acquire_owned()).await;
        let Ok(Ok(permit)) = permit else { continue };
        let Ok(accepted) = tokio::time::timeout(LOOKS_UP, listener.accept()).await else { continue };
        let Ok((stream, _)) = accepted else {
            // No descriptor is left: one will be when a connection has ended.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let service = TowerToHyperService::new(router.clone());
        let mut http = http1::Builder::new();
        http.timer(TokioTimer::new()).header_read_timeout(PATIENCE).keep_alive(true);
        let connection = http.serve_connection(TokioIo::new(stream), service);
        tokio::spawn(async move {
            // A reader that breaks off is no error of the server's; one that does not read gives its place up.
            let _ = tokio::time::timeout(LONGEST_CONNECTION, connection).await;
            drop(permit);
        });
    }
}

fn router(app: App) -> Router {
    Router::new()
        .route("/refit", get(part))
        .route("/refit.json", get(numbers))
        .route("/running", get(running))
        .route("/assets/{name}", get(asset))
        .route("/keep", post(keep))
        .route("/start", post(start))
        .route("/formula", get(formula).post(add_formula))
        .fallback(page)
        .with_state(Arc::new(app))
}

impl App {
    fn links(&self) -> Links {
        Links::Server { changes: self.guard.changes }
    }

    /// Computes beside the thread that reads and writes.
    async fn compute<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Site) -> Result<T, PagesError> + Send + 'static,
    ) -> Result<T, PagesError> {
        let gone = || PagesError::Request("the server is ending".to_owned());
        let permit = Arc::clone(&self.working).acquire_owned().await.map_err(|_| gone())?;
        let site = Arc::clone(&self.site);
        let work = tokio::task::spawn_blocking(move || {
            let done = job(&site);
            drop(permit);
            done
        });
        work.await.unwrap_or_else(|_| Err(PagesError::Request("this page failed; the others are there".to_owned())))
    }
}

async fn page(State(app): Shared, Asked(query): Asked<Query>, request: Request) -> Response {
    if let Err(refusal) = app.guard.may_read(request.headers()) {
        return refused(refusal);
    }
    if ![Method::GET, Method::HEAD].contains(request.method()) {
        return answer(StatusCode::METHOD_NOT_ALLOWED, "text/plain", "pages are read with GET".to_owned());
    }
    let (path, links) = (request.uri().path().to_owned(), app.links());
    html(app.compute(move |site| site.page(&path, &query, &links)).await)
}

async fn part(State(app): Shared, Asked(query): Asked<Query>, headers: HeaderMap) -> Response {
    if let Err(refusal) = app.guard.may_read(&headers) {
        return refused(refusal);
    }
    let links = app.links();
    html(app.compute(move |site| site.refit_part(&query, &links)).await)
}

async fn numbers(State(app): Shared, Asked(query): Asked<Query>, headers: HeaderMap) -> Response {
    if let Err(refusal) = app.guard.may_read(&headers) {
        return refused(refusal);
    }
    let refit = app.compute(move |site| site.refit(&query)).await;
    match refit.map(|refit| serde_json::to_string(&refit).unwrap_or_default()) {
        Ok(text) => answer(StatusCode::OK, "application/json", text),
        Err(error) => failed(&error),
    }
}

async fn running(State(app): Shared, headers: HeaderMap) -> Response {
    if let Err(refusal) = app.guard.may_read(&headers) {
        return refused(refusal);
    }
    html(app.compute(|site| Ok(crate::mission::running(site)?.into_string())).await)
}

async fn asset(State(app): Shared, Path(name): Path<String>, headers: HeaderMap) -> Response {
    if let Err(refusal) = app.guard.may_read(&headers) {
        return refused(refusal);
    }
    match ASSETS.iter().find(|(own, ..)| *own == name) {
        Some((_, kind, text)) => answer(StatusCode::OK, kind, (*text).to_owned()),
        None => answer(StatusCode::NOT_FOUND, "text/plain", "there is no such file".to_owned()),
    }
}

async fn keep(State(app): Shared, headers: HeaderMap, request: Request) -> Response {
    match asked::<Query>(&app, &headers, request).await {
        Ok(query) => html(app.compute(move |site| site.keep(&query)).await),
        Err(refusal) => refusal,
    }
}

async fn start(State(app): Shared, headers: HeaderMap, request: Request) -> Response {
    match asked::<Job>(&app, &headers, request).await {
        Ok(job) => html(app.compute(move |site| site.start(&job)).await),
        Err(refusal) => refusal,
    }
}

async fn formula(State(app): Shared, Asked(typed): Asked<Typed>, headers: HeaderMap) -> Response {
    if let Err(refusal) = app.guard.may_read(&headers) {
        return refused(refusal);
    }
    let links = app.links();
    html(app.compute(move |site| Ok(site.formula(&typed, &links))).await)
}

async fn add_formula(State(app): Shared, headers: HeaderMap, request: Request) -> Response {
    match asked::<Typed>(&app, &headers, request).await {
        Ok(typed) => html(app.compute(move |site| site.add_formula(&typed)).await),
        Err(refusal) => refusal,
    }
}

/// What a request that changes something asks for, or why it is refused.
async fn asked<T: DeserializeOwned>(app: &App, headers: &HeaderMap, request: Request) -> Result<T, Response> {
    app.guard.may_change(headers).map_err(refused)?;
    let body = tokio::time::timeout(PATIENCE, to_bytes(request.into_body(), BODY)).await;
    match body {
        Ok(Ok(bytes)) => serde_json::from_slice::<T>(&bytes)
            .map_err(|error| failed(&PagesError::Request(format!("the request is not understood: {error}")))),
        Ok(Err(_)) => Err(answer(StatusCode::PAYLOAD_TOO_LARGE, "text/plain", "the request is too large".to_owned())),
        Err(_) => Err(answer(StatusCode::REQUEST_TIMEOUT, "text/plain", "the request came too slowly".to_owned())),
    }
}

fn html(made: Result<String, PagesError>) -> Response {
    match made {
        Ok(text) => answer(StatusCode::OK, "text/html", text),
        Err(error) => failed(&error),
    }
}

fn failed(error: &PagesError) -> Response {
    use dragfree_archive::ArchiveError::NotFound;
    let status = match error {
        PagesError::NoPage(_) | PagesError::Archive(NotFound { .. }) => StatusCode::NOT_FOUND,
        PagesError::Request(_) | PagesError::Refit(_) | PagesError::Add(_) => StatusCode::BAD_REQUEST,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    };
    answer(status, "text/plain", error.to_string())
}

fn refused(refusal: Refusal) -> Response {
    let status = if refusal == Refusal::NoToken { StatusCode::UNAUTHORIZED } else { StatusCode::FORBIDDEN };
    let mut response = answer(status, "text/plain", refusal.words().to_owned());
    if refusal == Refusal::NoToken {
        let ask = header::HeaderValue::from_static("Basic realm=\"dragfree\", charset=\"UTF-8\"");
        response.headers_mut().insert(header::WWW_AUTHENTICATE, ask);
    }
    response
}

/// Headers of every answer: nothing from elsewhere is loaded, nothing is kept, no other page may hold this one in a
/// frame.
const HEADERS: [(HeaderName, &str); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
         base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    ),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::CACHE_CONTROL, "no-store"),
    (header::X_FRAME_OPTIONS, "DENY"),
];

fn answer(status: StatusCode, kind: &str, text: String) -> Response {
    let mut response = Response::new(Body::from(text));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    if let Ok(kind) = format!("{kind}; charset=utf-8").parse() {
        headers.insert(header::CONTENT_TYPE, kind);
    }
    for (name, value) in HEADERS {
        headers.insert(name, header::HeaderValue::from_static(value));
    }
    response
}
