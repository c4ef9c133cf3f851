------------------------------ MODULE entering ------------------------------
(* How a grant comes to its body: answered, then published; the body entered at the answer, and confirmed beside it.

   One ARC of one client, which needs all RCs. A reign is one term of one leader. It may be over at any moment, also
   between two things that it says in one instant, and then the next begins. All that was ever said may arrive at any
   later time, again, or never. RCs obey as in ownership.tla, which says that nobody else is obeyed by them: other
   programs are here for nothing but that a hold may end. So may an RC be lost from a leader's sight, or forget its hold.

   GUARDS names the guards that are in force, as in docs/promises/guards.md: taking one out must break a promise. *)
EXTENDS Naturals, Sequences, FiniteSets

CONSTANTS
    RCs,
    MaxTerm,    \* terms are 1 .. MaxTerm
    MaxSeq,     \* what one reign says: numbers of publications and notices are one series here
    None,
    GUARDS

On(guard) == guard \in GUARDS

(* A grant is <<term, seq>>, and so is the number of all that is said. *)
Newer(a, b) == a[1] > b[1] \/ (a[1] = b[1] /\ a[2] > b[2])
Nothing == <<0, 0>>

VARIABLES
    term, seq,  \* of who leads, and its last number
    leads,      \* whether it has taken the lead: it has heard what the RCs hold, or waited for a lease
    said,       \* [RCs -> grant, None, or Nothing yet]: what each answered to its promise, as long as that counts
    table,      \* what the ARC holds by its word
    saying,     \* what of the present instant is still to be said: a sequence of [to, number, grant]
    published,  \* what ever was: sets of <<number, grant>>
    told,       \* likewise, to the client
    ended,      \* grants that were ended: for others, by their time, as not confirmed, or as an RC was lost
    heard,      \* [RCs -> number]: the newest that it obeyed, or promised
    hold,       \* [RCs -> grant or None]
    had,        \* [RCs -> set of grants that it ever held]
    known,      \* the newest number that the client was told
    body,       \* the grant under which the body runs, or None
    confirmed,  \* RCs that have confirmed that
    refused,    \* the grant that the client reports as not confirmed, or None
    lost        \* grants that the client was told to be over

leader == <<term, seq, leads, said, table, saying>>
rcs == <<heard, hold, had>>
client == <<known, body, confirmed, refused, lost>>
vars == <<leader, published, told, ended, rcs, client>>

Init ==
    /\ term = 0 /\ seq = 0 /\ leads = FALSE /\ table = None /\ saying = <<>>
    /\ said = [r \in RCs |-> Nothing]
    /\ published = {} /\ told = {} /\ ended = {}
    /\ heard = [r \in RCs |-> Nothing] /\ hold = [r \in RCs |-> None] /\ had = [r \in RCs |-> {}]
    /\ known = Nothing /\ body = None /\ confirmed = {} /\ refused = None /\ lost = {}

-----------------------------------------------------------------------------
(* Reigns *)

NextReign ==
    /\ term < MaxTerm
    /\ term' = term + 1 /\ seq' = 0 /\ leads' = FALSE /\ table' = None /\ saying' = <<>>
    /\ said' = [r \in RCs |-> Nothing]
    /\ UNCHANGED <<published, told, ended, rcs, client>>

Promise(r) ==
    /\ term > 0 /\ ~ leads /\ said[r] = Nothing /\ heard[r][1] < term
    /\ heard' = [heard EXCEPT ![r] = <<term, 0>>]
    /\ said' = [said EXCEPT ![r] = hold[r]]
    /\ UNCHANGED <<term, seq, leads, table, saying, published, told, ended, hold, had, client>>

(* All RCs have answered; or, without the guard, whichever have. What some of them hold and not all is ended. *)
TakeLead ==
    /\ term > 0 /\ ~ leads
    /\ On("waits") => \A r \in RCs : said[r] # Nothing
    /\ LET whole == \E g \in {said[r] : r \in RCs} \ {None, Nothing} : \A r \in RCs : said[r] = g
           halves == {said[r] : r \in RCs} \ {None, Nothing}
       IN /\ table' = IF whole THEN CHOOSE g \in halves : TRUE ELSE None
          /\ ended' = IF whole \/ ~ On("waits") THEN ended ELSE ended \cup halves
          /\ seq' = 1
          /\ saying' = <<[to |-> "rcs", number |-> <<term, 1>>, grant |-> table']>>
    /\ leads' = TRUE
    /\ UNCHANGED <<term, said, published, told, rcs, client>>

Says(grant, order) ==
    /\ seq' = seq + 1
    /\ table' = grant
    /\ saying' = [i \in DOMAIN order |-> [to |-> order[i], number |-> <<term, seq + 1>>, grant |-> grant]]

Idle == leads /\ saying = <<>> /\ seq < MaxSeq

(* To who asks the answer goes first; to who waits, the publication. *)
Grants(order) ==
    /\ Idle /\ table = None
    /\ Says(<<term, seq + 1>>, order)
    /\ UNCHANGED <<term, leads, said, published, told, ended, rcs, client>>

Ends ==
    /\ Idle /\ table # None
    /\ ended' = ended \cup {table}
    /\ Says(None, <<"rcs", "client">>)
    /\ UNCHANGED <<term, leads, said, published, told, rcs, client>>

Say ==
    /\ saying # <<>>
    /\ LET one == Head(saying) IN
        IF one.to = "rcs" THEN published' = published \cup {<<one.number, one.grant>>} /\ UNCHANGED told
        ELSE told' = told \cup {<<one.number, one.grant>>} /\ UNCHANGED published
    /\ saying' = Tail(saying)
    /\ UNCHANGED <<term, seq, leads, said, table, ended, rcs, client>>

(* The client asks how its ARC stands. *)
Answer ==
    /\ Idle
    /\ Says(table, <<"client">>)
    /\ UNCHANGED <<term, leads, said, published, told, ended, rcs, client>>

(* It reports a grant that was not confirmed: that one ends, and no other. *)
HearRefused ==
    /\ Idle /\ refused # None
    /\ refused' = None
    /\ IF table # None /\ (table = refused \/ ~ On("by name"))
       THEN Says(None, <<"rcs", "client">>) /\ ended' = ended \cup {refused}
       ELSE Says(table, <<"client">>) /\ UNCHANGED ended
    /\ UNCHANGED <<term, leads, said, published, told, rcs, known, body, confirmed, lost>>

-----------------------------------------------------------------------------
(* RCs *)

Hear(r, one) ==
    /\ Newer(one[1], heard[r]) \/ one[1] = heard[r]
    /\ heard' = [heard EXCEPT ![r] = one[1]]
    /\ hold' = [hold EXCEPT ![r] = one[2]]
    /\ had' = [had EXCEPT ![r] = @ \cup {one[2]}]
    /\ <<heard', hold'>> # <<heard, hold>>
    /\ UNCHANGED <<leader, published, told, ended, client>>

(* It starts anew, or hears nobody for a hold lease. *)
Forget(r) ==
    /\ hold[r] # None
    /\ ended' = ended \cup {hold[r]}
    /\ hold' = [hold EXCEPT ![r] = None]
    /\ UNCHANGED <<leader, published, told, heard, had, client>>

-----------------------------------------------------------------------------
(* The client *)

Take(one) ==
    /\ On("newer") => Newer(one[1], known)
    /\ one[1] # known
    /\ known' = one[1]
    /\ IF one[2] \in lost \cup {body} THEN UNCHANGED <<body, confirmed>> ELSE body' = one[2] /\ confirmed' = {}
    /\ lost' = IF body # None /\ body' # body THEN lost \cup {body} ELSE lost
    /\ UNCHANGED <<leader, published, told, ended, rcs, refused>>

Confirm(r) ==
    /\ body # None /\ hold[r] = body /\ r \notin confirmed
    /\ confirmed' = confirmed \cup {r}
    /\ UNCHANGED <<leader, published, told, ended, rcs, known, body, refused, lost>>

(* For a second some RC did not confirm it. *)
Refuse ==
    /\ On("confirm") /\ body # None /\ confirmed # RCs /\ \E r \in RCs : hold[r] # body
    /\ refused' = body /\ lost' = lost \cup {body} /\ ended' = ended \cup {body}
    /\ body' = None /\ confirmed' = {}
    /\ UNCHANGED <<leader, published, told, rcs, known>>

Next ==
    \/ NextReign \/ TakeLead \/ Ends \/ Say \/ Answer \/ HearRefused \/ Refuse
    \/ Grants(<<"client", "rcs">>) \/ Grants(<<"rcs", "client">>)
    \/ \E r \in RCs : Promise(r) \/ Forget(r) \/ Confirm(r) \/ \E one \in published : Hear(r, one)
    \/ \E one \in told : Take(one)

Spec == Init /\ [][Next]_vars

-----------------------------------------------------------------------------
(* Promises *)

(* What all RCs have held, and nobody has ended, its client is never told to have lost. *)
Undisturbed == \A g \in lost : g \in ended \/ \E r \in RCs : g \notin had[r]

(* The client goes back in nothing that it believes. *)
Forward == [][~ Newer(known, known')]_known

(* A body does not go on under what not all of its RCs have confirmed, or will. *)
Waits == body # None /\ confirmed # RCs
Over == (Waits /\ \E r \in RCs : hold[r] # body) ~> (~ Waits \/ \A r \in RCs : hold[r] = body)

Fair == WF_vars(Refuse)
FairSpec == Spec /\ Fair
=============================================================================
