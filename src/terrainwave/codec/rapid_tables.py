import numpy as np, json
from functools import cache
_j=json.load(open("/work/shared/reference/prototypes/rapid/ew2_0.json"))
_F=np.zeros((4,4,9),np.int64)
for c in range(4):
    for p in range(3):
        w=_j[c][p]
        _F[c,p]=np.round(np.array([w[0],w[1],w[2],w[3],w[5],w[6],w[8],w[9],w[10]])*2**24).astype(np.int64)
    _F[c,3]=np.round(np.array([0.2,0,0,0,0.01,0.06,0,0,0])*2**24)
FEATURES=[_F]
def _d(b):
    if b==0:
        k=np.array([-1,9,9,-1])/16; w=np.r_[np.outer(k,k).ravel(),0,0,0]
    elif b==1:
        w=np.zeros(19); w[[0,1,2,3]]=np.array([-1,9,9,-1])/32; w[[9,12,14,15]]=np.array([9,9,-1,-1])/32
    else:
        w=np.zeros(23); w[[0,1,2,3]]=np.array([-1,9,9,-1])/32; w[[11,12,13,14]]=np.array([-1,9,9,-1])/32
    q=np.round(w*4096).astype(np.int64); i=np.argmax(np.abs(q)); q[i]+=4096-q.sum(); return q
STENCILS={1:[_d(0)],2:[_d(1)],3:[_d(2)]}
def family_of(step): return 0 if step==1 else 1 if step==3 else 2
@cache
def default_freqs(step):
    out=np.zeros((176,63),np.int64)
    for c in range(176):
        E=2**(-7+(c//4)/2+.25); k=max((c>>3)-8,0); E/=2**k
        q=np.arange(63)-31.0
        p=np.zeros(63)
        th=E/(1+E)
        p=th**np.abs(q)
        p[0]=1e-4*p.sum(); p/=p.sum()
        f=np.maximum(1,np.floor(p*(2048-63))).astype(np.int64)
        f[31]+=2048-f.sum()
        out[c]=f
    return out
