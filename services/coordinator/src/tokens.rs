//! `ign.v1.Tokens`: making, listing, rotating and revoking tokens. The table of access asks for `admin` everywhere.

use std::sync::Arc;
use std::time::Duration;

use ign_proto::v1::tokens_server::Tokens;
use ign_proto::{Cause, Grant, v1};
use ign_queue::{NewToken, Token};
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{parsed, to_timestamp};
use crate::error::internal;
use crate::http_answer::Refused;
use crate::token::mint;

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Tokens`.
pub(crate) struct TokensApi(pub(crate) Arc<App>);

#[tonic::async_trait]
impl Tokens for TokensApi {
    async fn create(&self, request: Request<v1::CreateTokenRequest>) -> Answer<v1::TokenSecret> {
        let by = caller(request.extensions())?;
        let request = request.into_inner();
        let grants: Vec<Grant> = request
            .grants
            .iter()
            .map(|grant| parsed(grant, "grants"))
            .collect::<Result<_, Refused>>()?;
        let minted = mint(None).map_err(|error| Refused(internal(&error)))?;
        let new = NewToken {
            id: minted.id,
            name: request.name,
            grants,
            secret: minted.secret,
            valid_for: valid_for(request.valid_secs)?,
        };
        let token = self
            .0
            .store
            .create_token(new)
            .await
            .map_err(Refused::from)?;
        tracing::info!(token.id, token.name, by = by.name, "token made");
        Ok(Response::new(v1::TokenSecret {
            token: Some(to_token(token)),
            secret: minted.text,
        }))
    }

    async fn list(
        &self,
        _request: Request<v1::ListTokensRequest>,
    ) -> Answer<v1::ListTokensResponse> {
        let tokens = self.0.store.tokens().await.map_err(Refused::from)?;
        Ok(Response::new(v1::ListTokensResponse {
            tokens: tokens.into_iter().map(to_token).collect(),
        }))
    }

    async fn rotate(&self, request: Request<v1::RotateTokenRequest>) -> Answer<v1::TokenSecret> {
        let by = caller(request.extensions())?;
        let request = request.into_inner();
        let grace = seconds(request.grace_secs, "grace_secs")?;
        let valid_for = valid_for(request.valid_secs)?;
        let tokens = self.0.store.tokens().await.map_err(Refused::from)?;
        let token = tokens
            .into_iter()
            .find(|it| {
                it.id == request.token || (it.name == request.token && it.revoked_at.is_none())
            })
            .ok_or_else(|| Refused(Cause::absent("token", &request.token)))?;
        let minted = mint(Some(&token.id)).map_err(|error| Refused(internal(&error)))?;
        let token = self
            .0
            .store
            .rotate_token(&token.id, minted.secret, grace, valid_for)
            .await
            .map_err(Refused::from)?;
        self.0.doorkeeper.forget();
        tracing::info!(token.id, token.name, by = by.name, "token rotated");
        Ok(Response::new(v1::TokenSecret {
            token: Some(to_token(token)),
            secret: minted.text,
        }))
    }

    async fn revoke(&self, request: Request<v1::RevokeTokenRequest>) -> Answer<v1::Token> {
        let by = caller(request.extensions())?;
        let token = self
            .0
            .store
            .revoke_token(&request.get_ref().token)
            .await
            .map_err(Refused::from)?;
        self.0.doorkeeper.forget();
        tracing::info!(token.id, token.name, by = by.name, "token revoked");
        Ok(Response::new(to_token(token)))
    }
}

fn seconds(secs: f64, field: &str) -> Result<Duration, Refused> {
    Duration::try_from_secs_f64(secs).map_err(|error| Refused(Cause::bad_field(field, error)))
}

fn valid_for(secs: f64) -> Result<Option<Duration>, Refused> {
    let valid_for = seconds(secs, "valid_secs")?;
    Ok((!valid_for.is_zero()).then_some(valid_for))
}

fn to_token(token: Token) -> v1::Token {
    v1::Token {
        id: token.id,
        name: token.name,
        grants: token.grants.iter().map(Grant::to_string).collect(),
        created_at: Some(to_timestamp(token.created_at)),
        expires_at: token.expires_at.map(to_timestamp),
        revoked_at: token.revoked_at.map(to_timestamp),
        last_used_on: token
            .last_used_on
            .map(|day| day.to_string())
            .unwrap_or_default(),
    }
}
