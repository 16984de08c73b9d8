//! The calls of the API: one table that the router is built from and the OpenAPI document is compared with.

use super::events::{CaptureEvent, Events};
use super::files::{self, BytesRequest, FileDigest, FileRequest, RecordingFiles};
use super::page::{self, LIVE, PageAddress};
use super::recordings::{self, MarkRequest, NameRequest, Recording, Recordings, ReportPage, Tickets};
use super::reply::Refusal;
use super::requests::{
    CameraRequest, FingerprintRequest, LoopRequest, NoteRequest, RateRequest, StepRequest,
};
use super::{SERVER_HEADER, allowed, frames, guard, limits, live};
use crate::control::{
    CalibratedImage, CameraControls, Control, ControlChanges, ControlList, ControlRequest, EpisodeRequest,
    FollowRequest, GridStreams, RecordRequest, RecordingEpisodes, ReplayControl, SeekRequest, StopRequest,
};
use crate::doctor::Examined;
use crate::losses::RecordingLosses;
use crate::metrics;
use crate::status::{CameraState, CameraStatus, RecordingStatus, ReplayStatus, RigStatus};
use crate::{Error, ErrorKind};
use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Path as UrlPath, Query, Request, State};
use axum::http::{HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use axum::{Extension, Json, Router};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Episode, SessionChanges, edit};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// The OpenAPI 3.1 document of the API.
pub const OPENAPI: &str = include_str!("openapi.json");

type Rig = Arc<dyn Control>;
type Answer<T> = Result<T, Refusal>;

/// A call of the API.
#[derive(Debug, Clone, Copy)]
pub struct Route {
    /// `GET` or `POST`.
    pub method: &'static str,
    /// Its path.
    pub path: &'static str,
    handler: fn() -> MethodRouter<Rig>,
}

/// Events of a calibration, posted and followed.
const CALIBRATION_EVENTS: &str = "/v1/calibration/events";

/// Every call of the API.
pub const ROUTES: [Route; 40] = [
    Route { method: "GET", path: "/v1/status", handler: || get(status) },
    Route { method: "GET", path: "/v1/health", handler: || get(health) },
    Route { method: "GET", path: "/v1/config", handler: || get(config) },
    Route { method: "GET", path: "/v1/frames/{camera}/{stream}", handler: || get(frames::upgrade) },
    Route { method: "GET", path: "/v1/record", handler: || get(record) },
    Route { method: "GET", path: "/v1/record/losses", handler: || get(record_losses) },
    Route { method: "POST", path: "/v1/record/start", handler: || post(record_start) },
    Route { method: "POST", path: "/v1/record/stop", handler: || post(record_stop) },
    Route { method: "POST", path: "/v1/record/note", handler: || post(record_note) },
    Route { method: "POST", path: "/v1/session/follow", handler: || post(session_follow) },
    Route { method: "POST", path: "/v1/episode", handler: || post(episode) },
    Route { method: "GET", path: "/v1/episodes", handler: || get(episodes) },
    Route { method: "GET", path: "/v1/recordings", handler: || get(recordings_list) },
    Route { method: "GET", path: "/v1/recordings/image", handler: || get(recordings_image) },
    Route { method: "POST", path: "/v1/recordings/mark", handler: || post(recordings_mark) },
    Route { method: "POST", path: "/v1/recordings/report", handler: || post(recordings_report) },
    Route { method: "POST", path: "/v1/recordings/files", handler: || post(recordings_files) },
    Route { method: "POST", path: "/v1/recordings/bytes", handler: || post(recordings_bytes) },
    Route { method: "POST", path: "/v1/recordings/digest", handler: || post(recordings_digest) },
    Route { method: "GET", path: "/v1/report/{ticket}", handler: || get(report) },
    Route { method: "GET", path: "/v1/doctor", handler: || get(doctor) },
    Route { method: "GET", path: "/v1/controls", handler: || get(controls) },
    Route { method: "POST", path: "/v1/controls", handler: || post(controls_set) },
    Route { method: "POST", path: "/v1/controls/revert", handler: || post(controls_revert) },
    Route { method: "GET", path: "/v1/controls/changes", handler: || get(controls_changes) },
    Route { method: "POST", path: "/v1/controls/save", handler: || post(controls_save) },
    Route { method: "GET", path: "/v1/replay", handler: || get(replay) },
    Route { method: "POST", path: "/v1/replay/pause", handler: || post(replay_pause) },
    Route { method: "POST", path: "/v1/replay/resume", handler: || post(replay_resume) },
    Route { method: "POST", path: "/v1/replay/seek", handler: || post(replay_seek) },
    Route { method: "POST", path: "/v1/replay/step", handler: || post(replay_step) },
    Route { method: "POST", path: "/v1/replay/rate", handler: || post(replay_rate) },
    Route { method: "POST", path: "/v1/replay/loop", handler: || post(replay_loop) },
    Route { method: "GET", path: "/v1/calibration", handler: || get(calibration) },
    Route { method: "GET", path: CALIBRATION_EVENTS, handler: || get(calibration_follow) },
    Route { method: "POST", path: CALIBRATION_EVENTS, handler: || post(calibration_post) },
    Route { method: "POST", path: "/v1/stop", handler: || post(stop) },
    Route { method: "GET", path: "/v1/page", handler: || get(page_address) },
    Route { method: "GET", path: "/v1/openapi.json", handler: || get(openapi) },
    Route { method: "GET", path: "/metrics", handler: || get(scrape) },
];

/// Whether every camera streams.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Health {
    /// Whether every camera streams.
    pub healthy: bool,
    /// The cameras that do not.
    pub reasons: Vec<HealthReason>,
}

/// A camera that does not stream.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HealthReason {
    /// Its name.
    pub camera: String,
    /// Its state.
    pub state: CameraState,
    /// Why.
    pub message: Option<String>,
}

impl Health {
    /// The health of a rig with these cameras.
    pub fn of(cameras: &[CameraStatus]) -> Self {
        let ill = cameras.iter().filter(|c| c.state != CameraState::Streaming);
        let reason = |c: &CameraStatus| HealthReason {
            camera: c.name.clone(),
            state: c.state,
            message: c.message.clone(),
        };
        let reasons: Vec<_> = ill.map(reason).collect();
        Self { healthy: reasons.is_empty(), reasons }
    }
}

pub(super) fn router(control: Rig, events: Events) -> Router {
    let router = ROUTES.iter().fold(Router::new(), |router, r| router.route(r.path, (r.handler)()));
    let router = page::FILES.iter().fold(router, |router, file| router.route(&file.path(), file.handler()));
    router
        .route(LIVE, get(live::upgrade))
        .fallback(unknown_path)
        .method_not_allowed_fallback(wrong_method)
        .with_state(control)
        .layer(Extension(events))
        .layer(Extension(Tickets::default()))
        .layer(middleware::from_fn(limits::whole_body))
        .layer(middleware::from_fn(guard::json_posts))
        .layer(middleware::from_fn(name_server))
}

/// Names the version in every answer, so that a client of another version can report it.
async fn name_server(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let name = HeaderValue::from_static(concat!("depthrig/", env!("CARGO_PKG_VERSION")));
    response.headers_mut().insert(SERVER_HEADER, name);
    response
}

async fn status(State(rig): State<Rig>) -> Answer<Json<RigStatus>> {
    call(rig, |rig| Ok(rig.status())).await.map(Json)
}

async fn health(State(rig): State<Rig>) -> Answer<(StatusCode, Json<Health>)> {
    let health = Health::of(&call(rig, |rig| Ok(rig.status())).await?.cameras);
    let status = if health.healthy { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    Ok((status, Json(health)))
}

async fn config(State(rig): State<Rig>) -> Answer<Response> {
    let text = call(rig, |rig| Ok(rig.config_text())).await?;
    Ok(([(header::CONTENT_TYPE, "application/toml; charset=utf-8")], text).into_response())
}

async fn record(State(rig): State<Rig>) -> Answer<Json<Option<RecordingStatus>>> {
    call(rig, |rig| Ok(rig.status().recording)).await.map(Json)
}

async fn record_losses(State(rig): State<Rig>) -> Answer<Json<Option<RecordingLosses>>> {
    call(rig, |rig| Ok(rig.record_losses())).await.map(Json)
}

async fn record_start(State(rig): State<Rig>, body: Bytes) -> Answer<Json<RecordingStatus>> {
    let mut request: RecordRequest = parse(&body)?;
    call(rig, move |rig| {
        if let Some(directory) = &request.directory {
            request.directory = Some(allowed::below(directory, &rig.recording_roots())?);
        }
        rig.record_start(&request)
    })
    .await
    .map(Json)
}

async fn record_stop(State(rig): State<Rig>, body: Bytes) -> Answer<Json<RecordingStatus>> {
    let request: StopRequest = parse(&body)?;
    call(rig, move |rig| {
        let status = rig.record_stop()?;
        if let Some(mark) = request.mark {
            let changes = SessionChanges { mark: Some(Some(mark)), ..SessionChanges::default() };
            edit(&RealFs, Path::new(&status.path), &changes).map_err(|e| {
                let what = format!("the recording is closed, and could not be marked {}: {e}", mark.name());
                Error::new(ErrorKind::Other, what).with_source(e)
            })?;
        }
        Ok(status)
    })
    .await
    .map(Json)
}

async fn recordings_list(State(rig): State<Rig>) -> Answer<Json<Recordings>> {
    call(rig, recordings::list).await.map(Json)
}

async fn recordings_image(
    State(rig): State<Rig>,
    of: Result<Query<NameRequest>, QueryRejection>,
) -> Answer<Response> {
    let Query(of) = of.map_err(|e| Refusal::new(StatusCode::BAD_REQUEST, e.body_text()))?;
    call(rig, move |rig| recordings::image(rig, &of.name)).await
}

async fn recordings_mark(State(rig): State<Rig>, body: Bytes) -> Answer<Json<Recording>> {
    let request: MarkRequest = parse(&body)?;
    call(rig, move |rig| recordings::mark(rig, &request)).await.map(Json)
}

async fn recordings_report(
    State(rig): State<Rig>,
    Extension(tickets): Extension<Tickets>,
    body: Bytes,
) -> Answer<Json<ReportPage>> {
    let of: NameRequest = parse(&body)?;
    call(rig, move |rig| tickets.issue(rig, &of.name)).await.map(Json)
}

async fn recordings_files(State(rig): State<Rig>, body: Bytes) -> Answer<Json<RecordingFiles>> {
    let of: NameRequest = parse(&body)?;
    call(rig, move |rig| files::list(rig, &of.name)).await.map(Json)
}

async fn recordings_bytes(State(rig): State<Rig>, body: Bytes) -> Answer<Response> {
    let part: BytesRequest = parse(&body)?;
    let bytes = call(rig, move |rig| files::bytes(rig, &part)).await?;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}

async fn recordings_digest(State(rig): State<Rig>, body: Bytes) -> Answer<Json<FileDigest>> {
    let file: FileRequest = parse(&body)?;
    call(rig, move |rig| files::digest(rig, &file)).await.map(Json)
}

async fn report(
    State(rig): State<Rig>,
    Extension(tickets): Extension<Tickets>,
    UrlPath(ticket): UrlPath<String>,
) -> Answer<Response> {
    call(rig, move |_| tickets.report(&ticket)).await
}

async fn controls(State(rig): State<Rig>) -> Answer<Json<ControlList>> {
    call(rig, |rig| rig.controls()).await.map(Json)
}

async fn controls_set(State(rig): State<Rig>, body: Bytes) -> Answer<Json<CameraControls>> {
    let request: ControlRequest = parse(&body)?;
    call(rig, move |rig| rig.set_control(&request)).await.map(Json)
}

async fn controls_revert(State(rig): State<Rig>, body: Bytes) -> Answer<Json<CameraControls>> {
    let of: CameraRequest = parse(&body)?;
    call(rig, move |rig| rig.revert_controls(&of.camera)).await.map(Json)
}

async fn controls_changes(State(rig): State<Rig>) -> Answer<Json<ControlChanges>> {
    call(rig, |rig| rig.control_changes()).await.map(Json)
}

async fn controls_save(State(rig): State<Rig>, body: Bytes) -> Answer<Json<ControlChanges>> {
    let of: FingerprintRequest = parse(&body)?;
    call(rig, move |rig| rig.save_controls(&of.fingerprint)).await.map(Json)
}

async fn doctor(State(rig): State<Rig>) -> Answer<Json<Examined>> {
    call(rig, |rig| rig.doctor()).await.map(Json)
}

async fn record_note(State(rig): State<Rig>, body: Bytes) -> Answer<StatusCode> {
    let note: NoteRequest = parse(&body)?;
    call(rig, move |rig| rig.record_note(&note.text)).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn session_follow(State(rig): State<Rig>, body: Bytes) -> Answer<Json<GridStreams>> {
    let request: FollowRequest = parse(&body)?;
    call(rig, move |rig| rig.follow(&request)).await.map(Json)
}

async fn episode(State(rig): State<Rig>, body: Bytes) -> Answer<Json<Episode>> {
    let request: EpisodeRequest = parse(&body)?;
    call(rig, move |rig| rig.episode(&request)).await.map(Json)
}

async fn episodes(State(rig): State<Rig>) -> Answer<Json<Option<RecordingEpisodes>>> {
    call(rig, |rig| Ok(rig.episodes())).await.map(Json)
}

async fn replay(State(rig): State<Rig>) -> Answer<Json<ReplayStatus>> {
    of_replay(rig, |replay| Ok(replay.status())).await
}

async fn replay_pause(State(rig): State<Rig>) -> Answer<Json<ReplayStatus>> {
    of_replay(rig, |replay| replay.pause()).await
}

async fn replay_resume(State(rig): State<Rig>) -> Answer<Json<ReplayStatus>> {
    of_replay(rig, |replay| replay.resume()).await
}

async fn replay_seek(State(rig): State<Rig>, body: Bytes) -> Answer<Json<ReplayStatus>> {
    let to: SeekRequest = parse(&body)?;
    of_replay(rig, move |replay| replay.seek(&to)).await
}

async fn replay_step(State(rig): State<Rig>, body: Bytes) -> Answer<Json<ReplayStatus>> {
    let step: StepRequest = parse(&body)?;
    of_replay(rig, move |replay| replay.step(step.sets)).await
}

async fn replay_rate(State(rig): State<Rig>, body: Bytes) -> Answer<Json<ReplayStatus>> {
    let request: RateRequest = parse(&body)?;
    of_replay(rig, move |replay| replay.set_rate(request.rate)).await
}

async fn replay_loop(State(rig): State<Rig>, body: Bytes) -> Answer<Json<ReplayStatus>> {
    let request: LoopRequest = parse(&body)?;
    of_replay(rig, move |replay| replay.set_loop(request.on)).await
}

/// Runs a call of the replay, when the rig is one.
async fn of_replay(
    rig: Rig,
    what: impl FnOnce(&dyn ReplayControl) -> crate::Result<ReplayStatus> + Send + 'static,
) -> Answer<Json<ReplayStatus>> {
    let on_replay = move |rig: &dyn Control| {
        let none = || {
            let why = "this rig has cameras and is not a replay; start one with: depthrig replay DATASET";
            Error::new(ErrorKind::WrongState, why)
        };
        what(rig.replay().ok_or_else(none)?)
    };
    call(rig, on_replay).await.map(Json)
}

async fn calibration(State(rig): State<Rig>) -> Answer<Json<Vec<CalibratedImage>>> {
    call(rig, |rig| Ok(rig.calibration())).await.map(Json)
}

async fn calibration_post(Extension(events): Extension<Events>, body: Bytes) -> Answer<StatusCode> {
    let event: CaptureEvent = parse(&body)?;
    events.post(&event)?;
    Ok(StatusCode::NO_CONTENT)
}

async fn calibration_follow(Extension(events): Extension<Events>) -> Answer<Response> {
    events.follow()
}

async fn stop(State(rig): State<Rig>) -> Answer<StatusCode> {
    call(rig, |rig| {
        rig.request_stop();
        Ok(())
    })
    .await?;
    Ok(StatusCode::ACCEPTED)
}

async fn page_address(Extension(address): Extension<PageAddress>) -> Json<PageAddress> {
    Json(address)
}

async fn openapi() -> Response {
    ([(header::CONTENT_TYPE, "application/json")], OPENAPI).into_response()
}

async fn scrape(State(rig): State<Rig>) -> Answer<Response> {
    let text = call(rig, |rig| Ok(metrics::render(&rig.status()))).await?;
    Ok(([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response())
}

async fn unknown_path(uri: Uri) -> Refusal {
    let paths: Vec<_> = ROUTES.iter().map(|r| r.path).collect();
    let message = format!("there is no {}; there are {}", uri.path(), paths.join(", "));
    Refusal::new(StatusCode::NOT_FOUND, message)
}

async fn wrong_method(method: Method, uri: Uri) -> Refusal {
    let wanted: Vec<&str> = ROUTES.iter().filter(|r| r.path == uri.path()).map(|r| r.method).collect();
    let wanted = wanted.join(" and ");
    let message = format!("{} answers to {wanted}, not to {method}", uri.path());
    Refusal::new(StatusCode::METHOD_NOT_ALLOWED, message)
}

/// Runs a call of the rig where it may take its time.
async fn call<T: Send + 'static>(
    rig: Rig,
    what: impl FnOnce(&dyn Control) -> crate::Result<T> + Send + 'static,
) -> Answer<T> {
    match tokio::task::spawn_blocking(move || what(&*rig)).await {
        Ok(result) => result.map_err(Refusal::from),
        Err(e) => {
            tracing::error!(error = %e, "a call of the control API failed inside");
            let message = "the call failed inside the daemon; its log says more";
            Err(Error::new(ErrorKind::Other, message).into())
        }
    }
}

/// The body as JSON; an empty one is an empty object.
fn parse<T: DeserializeOwned>(body: &[u8]) -> Answer<T> {
    let text = if body.is_empty() { b"{}".as_slice() } else { body };
    serde_json::from_slice(text)
        .map_err(|e| Refusal::new(StatusCode::BAD_REQUEST, format!("the body is wrong: {e}")))
}
